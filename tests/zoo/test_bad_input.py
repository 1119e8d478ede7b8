"""Whatever is typed wrongly: one line that helps, exit status 2, nothing written."""

import os
import pickle
import shutil
import sys
import zipfile
from pathlib import Path

import pytest
import yaml
from cost_envs import CostPoint
from registered_envs import Broken, Filmed
from typed import refused

from sb3_guard import ALGORITHMS, CPO, enjoy, train
from sb3_guard.envs.rendering import RenderingError
from sb3_guard.zoo.run.checkpoint import MEMBER

SUPPORT = Path(__file__).parents[1] / "support"
TOY = ["--gym-packages", "registered_envs", "--env", "CostPoint-v0"]
LIMITED = [*TOY, "-params", "cost_limit:2"]
GO_ON = [*TOY[:2], "-i"]
SMALL = ["-params", "n_envs:2", "n_steps:30", "n_critic_updates:3", "cost_limit:2",
         "-n", "60", "--verbose", "0", "--env-kwargs", "episode_length:20",
         "--eval-freq", "-1", "--seed", "1"]  # fmt: skip


TRAIN = [
    # algorithm
    (["--algo", "cpp"], ["unknown algorithm 'cpp'", "did you mean 'cpo'?", "trpo"]),
    # environment
    (["--env", "Goal_Pint_8Hazards"], ["'Pint'", "'Point'"]),
    (["--env", "scene.yml"], ["'scene.yml' is a file", "sb3_guard.register"]),
    (["--env", "Nonsense"], ["'Nonsense'", "--gym-packages"]),
    (["--env", "go1.xml"], ["register_robot(NAME, xml='go1.xml')"]),
    (["--env", "no_such_module:Env-v0"], ["no_such_module"]),
    (["--env-kwargs", "hazard:{}"], ["'hazard'", "hazards"]),
    (["--env-kwargs", "max_steps:100"], ["'max_steps'", "'max_episode_steps'"]),
    ([*LIMITED, "--env-kwargs", "length:3"], ["CostPoint-v0", "'length'"]),
    (["--env-kwargs", "hazards:{'num':200}"], ["Goal_Point_8Hazards-v0", "LayoutError", "hazards"]),
    ([*LIMITED, "--vec-env", "native"],
     ["'CostPoint-v0' is not an sb3_guard environment", "'dummy' or 'subproc'"]),
    # an environment without the cost key
    ([*LIMITED, "--env", "NoCost-v0"],
     ["no cost key 'cost'", "depth", "cost_keys", "missing_cost='zero'"]),
    # hyperparameters
    (["--algo", "sac_lag", "--env", "CartPole-v1", "-params", "missing_cost:zero", "cost_limit:1"],
     ["continuous actions (Box)", "PPOLag"]),
    (["-params", "policy:MlpPolcy"], ["no policy 'MlpPolcy'", "did you mean 'MlpPolicy'?"]),
    (["-params", "policy_kwargs:dict(net_ark=[3])"], ["net_ark"]),
    (["--algo", "ppo", "-params", "n_steps:1e15"], ["ppo can't be made", "allocate", "10000000"]),
    (["--gym-packages", "../x"], ["--gym-packages: can't import '../x'"]),
    # flags
    (["--device", "abacus"], ["abacus"]),
    (["-i", "absent"], ["no run folder absent"]),
    ([*LIMITED, "-i", "absent.zip"], ["can't load absent.zip", "No such file"]),
]  # fmt: skip


@pytest.mark.parametrize(("arguments", "parts"), TRAIN, ids=lambda one: " ".join(one)[:40])
def test_train(arguments, parts, capsys, empty):
    refused(train.main, ["-n", "100", "--verbose", "0", *arguments], capsys, *parts)


ENJOY = [
    ([], ["there is no run of cpo on Goal_Point_8Hazards-v0 in 'logs'", "sb3-guard train"]),
    (["--exp-id", "7"], ["there is no run folder", "_7"]),
    (["-f", "nowhere"], ["'nowhere'"]),
]


@pytest.mark.parametrize(("arguments", "parts"), ENJOY, ids=lambda one: " ".join(one)[:40])
def test_enjoy(arguments, parts, capsys, empty):
    refused(enjoy.main, ["--no-render", *arguments], capsys, *parts)


def test_a_module_that_fails(capsys, empty, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "odd_robot.py").write_text("robot.register()")
    said = "--gym-packages: can't import 'odd_robot': NameError: name 'robot' is not defined"
    refused(train.main, ["--gym-packages", "odd_robot"], capsys, said)


def test_constructor_of_an_environment(capsys, empty, monkeypatch):
    """What a user's environment refuses is one line, however many its message has."""
    whole = CostPoint.__init__

    def refuse(self, kind="fine", **kwargs):
        if kind != "fine":
            raise TypeError(f"{kind}\n  is allowed\n  nowhere")
        whole(self, **kwargs)

    monkeypatch.setattr(CostPoint, "__init__", refuse)
    for flag in ("--env-kwargs", "--eval-env-kwargs"):
        arguments = ["-n", "60", *LIMITED, flag, "kind:odd"]
        refused(train.main, arguments, capsys, "can't make CostPoint-v0", "odd is allowed nowhere")


def test_track_without_wandb(capsys, empty, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    refused(train.main, [*TOY, *SMALL, "--track"], capsys, "wandb")


def test_more_than_plain_data(capsys, tmp_path):
    conf = tmp_path / "conf.py"
    conf.write_text(
        "from torch import nn\n"
        "hyperparams = {'default': {'policy_kwargs': {'activation_fn': nn.ReLU}, 'n_steps': 30}}\n"
    )
    arguments = [*LIMITED, "-n", "60", "-conf", str(conf), "-f", str(tmp_path / "logs")]
    refused(train.main, arguments, capsys, "is more than plain data", "nn.ReLU")
    assert not (tmp_path / "logs").exists()


def test_unwritable_log_folder(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    arguments = [*TOY, *SMALL, "-f", str(tmp_path / "file")]
    refused(train.main, arguments, capsys, f"can't write to {tmp_path / 'file'}")
    if os.getuid() != 0:  # nothing is forbidden to root
        (tmp_path / "locked").mkdir(mode=0o500)
        refused(train.main, [*TOY, *SMALL, "-f", str(tmp_path / "locked")], capsys, "locked")


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("logs")
    assert train.main([*TOY, *SMALL, "-f", str(folder)]) == 0
    return folder


@pytest.fixture
def run(logs, tmp_path):
    return shutil.copytree(logs, tmp_path, dirs_exist_ok=True) / "cpo" / "CostPoint-v0_1"


def test_corrupt_checkpoint(capsys, run):
    content = run.joinpath("checkpoint.zip").read_bytes()[:-2000]
    run.joinpath("checkpoint.zip").write_bytes(content)
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    for path in (run, run / "checkpoint.zip"):
        arguments = [*GO_ON, str(path), "-n", "120"]
        refused(train.main, arguments, capsys, "checkpoint.zip is damaged or no checkpoint")
    after = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert before == after


def test_checkpoints_that_are_none(capsys, run):
    run.joinpath("checkpoint.zip").unlink()
    refused(train.main, [*GO_ON, str(run), "-n", "120"], capsys, "start it again without -i")
    shutil.copy(run / "CostPoint-v0.zip", run / "checkpoint.zip")
    refused(train.main, [*GO_ON, str(run), "-n", "120"], capsys, "damaged or no checkpoint", MEMBER)
    with zipfile.ZipFile(run / "checkpoint.zip", "a") as archive:
        archive.writestr(MEMBER, pickle.dumps({"other": 1}))
    refused(train.main, [*GO_ON, str(run), "-n", "120"], capsys, "checkpoint.zip is damaged or")


def test_corrupt_model(capsys, run, tmp_path):
    run.joinpath("CostPoint-v0.zip").write_bytes(b"no zip at all")
    refused(
        enjoy.main,
        [*TOY, "-f", str(tmp_path), "--no-render"],
        capsys,
        "can't load",
        "CostPoint-v0.zip",
    )
    warm = [*TOY, *SMALL, "-i", str(run / "CostPoint-v0.zip"), "-f", str(tmp_path / "new")]
    refused(train.main, warm, capsys, "can't load")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (["--seed", "2"], ["seed = 2 contradicts 1"]),
        (["--algo", "trpo"], ["algo = trpo contradicts cpo"]),
        (["--env", "NoCost-v0"], ["env = NoCost-v0 contradicts CostPoint-v0"]),
        (["-params", "n_steps:31"], ["n_steps = 31 contradicts 30"]),
        (["-params", "gamma:0.9"], ["gamma = 0.9 contradicts unset, with which"]),
        (["-params", "gama:1"], ["no hyperparameter 'gama'", "'gamma'"]),
        (["-conf", "paper"], ["conf_file = paper contradicts"]),
    ],
)
def test_flags_that_contradict_the_run(arguments, parts, capsys, run):
    refused(train.main, [*GO_ON, str(run), *arguments], capsys, *parts)


def test_the_runs_own_flags_may_be_repeated(run):
    arguments = ["-i", str(run), *TOY, "-params", "n_steps:3e1", "-n", "120"]
    assert train.main([*arguments, "--env-kwargs", "episode_length:20", "--seed", "1"]) == 0


def test_an_agent_of_nan_is_not_trained_on(capsys, run, tmp_path):
    model = CPO.load(run / "CostPoint-v0.zip", device="cpu")
    model.policy.action_net.bias.data[0] = float("nan")
    model.save(tmp_path / "nan.zip")
    warm = [*TOY, *SMALL, "-i", str(tmp_path / "nan.zip"), "-f", str(tmp_path / "new")]
    refused(train.main, warm, capsys, "can't train", "'action_net.bias' are not finite")


def test_other_algorithms_agent(capsys, run, tmp_path):
    warm = [*TOY, *SMALL, "--algo", "trpo", "-i", str(run / "CostPoint-v0.zip")]
    refused(train.main, [*warm, "-f", str(tmp_path / "new")], capsys, "can't load", "as TRPO")


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        (lambda args: {"a": 1}, ["unknown entry 'a'"]),
        (lambda args: {**args, "seed": "one"}, ["seed = 'one' must be"]),
    ],
)
def test_damaged_flags(change, parts, capsys, run):
    path = run / "CostPoint-v0" / "args.yml"
    path.write_text(yaml.safe_dump(change(yaml.safe_load(path.read_text()))))
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    refused(train.main, [*GO_ON, str(run), "-n", "120"], capsys, "args.yml: ", *parts)
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


def test_no_backend_for_a_window(capsys, tmp_path, monkeypatch):
    """Whatever needs OpenGL first says so on one line."""

    def fail(self, *args, **kwargs):
        raise RenderingError("no OpenGL backend works here")

    filmed = [*TOY, "--env", "Filmed-v0", "-f", str(tmp_path)]
    assert train.main([*filmed, *SMALL]) == 0
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setitem(Filmed.metadata, "render_modes", ["human"])
    monkeypatch.setattr(Filmed, "render", fail)
    refused(enjoy.main, filmed, capsys, "RenderingError: no OpenGL backend works here")


def test_an_update_that_is_not_a_number(capsys, tmp_path, monkeypatch):
    """No result and no model of a run that diverged; a model that was there before stays."""
    whole = CPO.train

    def diverge(self) -> None:
        if self.num_timesteps > 60:
            raise FloatingPointError("value_loss is nan")
        whole(self)

    arguments = [*TOY, *SMALL, "-f", str(tmp_path)]
    run = tmp_path / "cpo" / "CostPoint-v0_1"
    with monkeypatch.context() as patch:
        patch.setattr(CPO, "train", diverge)
        parts = ("120 steps: ", "value_loss is nan")
        refused(train.main, [*arguments, "-n", "180"], capsys, *parts, status=1)
        assert not (run / "result.json").exists() and not (run / "CostPoint-v0.zip").exists()
        assert train.main(arguments) == 0
        run = run.with_name("CostPoint-v0_2")
        model = (run / "CostPoint-v0.zip").read_bytes()
        refused(train.main, [*GO_ON, str(run), "-n", "180"], capsys, parts[1], status=1)
    assert not (run / "result.json").exists()
    assert (run / "CostPoint-v0.zip").read_bytes() == model
    assert train.main([*GO_ON, str(run)]) == 0
    assert (run / "result.json").exists()


def test_kept_model_that_is_not_there(capsys, run, tmp_path):
    play = [*TOY, "-f", str(tmp_path), "--no-render"]
    refused(enjoy.main, [*play, "--load-checkpoint", "30"], capsys, "no model at 30 steps")
    refused(enjoy.main, [*play, "--load-best"], capsys, "best_model.zip", "--load-final takes")


@pytest.mark.parametrize(
    ("env", "parts"),
    [("Flickering-v0", ["training stopped at", "is nan: a cost must be a finite number"]),
     ("Wordy-v0", ["fails at its first step: info['cost'] is 'high': a cost must be"])],
)  # fmt: skip
def test_costs_of_a_baseline(env, parts, capsys, tmp_path):
    arguments = f"--algo ppo --env {env} -n 64 -params n_envs:1 batch_size:32 n_steps:64".split()
    arguments += ["--gym-packages", "registered_envs", "--eval-freq", "-1", "--device", "cpu"]
    status = 1 if "stopped" in parts[0] else 2
    refused(train.main, [*arguments, "-f", str(tmp_path)], capsys, *parts, status=status)
    assert not list(tmp_path.rglob("result.json"))


@pytest.mark.parametrize(
    ("error", "after"),
    [
        (EOFError("of a simulator"), 20),
        (KeyError("mine"), -1),
    ],
)
def test_an_exception_of_the_users_keeps_its_traceback(error, after, tmp_path, monkeypatch):
    """The first step is no exception."""
    monkeypatch.setattr(Broken, "error", error)
    monkeypatch.setattr(Broken, "after", after)
    arguments = "--algo ppo --env Broken-v0 -n 64 -params n_envs:1 n_steps:64 batch_size:32".split()
    arguments += ["--gym-packages", "registered_envs", "--eval-freq", "-1", "--device", "cpu"]
    with pytest.raises(type(error), match=error.args[0]):
        train.main([*arguments, "-f", str(tmp_path)])


@pytest.mark.parametrize(("algo", "what"), [("sac", "reward"), ("cpo", "observation")])
def test_what_is_not_a_number_ends_training_in_a_line(algo, what, capsys, tmp_path):
    params = ["learning_starts:10" if algo == "sac" else "n_steps:64"]
    params += ["cost_limit:2"] if algo in ALGORITHMS else []
    arguments = f"--algo {algo} --env Undefined-v0 -n 64 --env-kwargs what:{what}".split()
    arguments += [*TOY[:2], "--eval-freq", "-1", "-params", "n_envs:1", "batch_size:32", *params]
    assert train.main([*arguments, "-f", str(tmp_path)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: training stopped at 30 steps: the {what} of environment 0 is ")
    assert not list(tmp_path.rglob("result.json"))


def test_a_run_whose_files_were_edited(run, capsys):
    path = run / "CostPoint-v0" / "config.yml"
    values = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**values, "n_steps": 31}))
    refused(train.main, [*GO_ON, str(run), "-n", "120"], capsys, "n_steps = 31 contradicts 30")
    path.write_text(yaml.safe_dump({**values, "reuse": 0}))
    refused(train.main, [*GO_ON, str(run), "-n", "120"], capsys, "no hyperparameter 'reuse'")
    path.write_text(yaml.safe_dump(values))
