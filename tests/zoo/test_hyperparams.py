"""Hyperparameters: which entry is read, what is refused, what becomes of the values."""

import pytest
import torch
from torch import nn

from sb3_guard.algorithms import ALGORITHMS, CPO, SACLag
from sb3_guard.envs import env_ids
from sb3_guard.fields import parse_value
from sb3_guard.zoo.cli.names import BASES, classes
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.algos import baselines
from sb3_guard.zoo.run.hyperparams import (
    annotations,
    check,
    hyperparams_folder,
    model_arguments,
    normalization,
    read_file,
    read_hyperparams,
)

FILE = """
default: &default
  n_timesteps: !!float 1e5
  n_steps: 100
Goal_Point_8Hazards-v0:
  <<: *default
  n_steps: 200
Bare_Name:
  n_steps: 300
"*_Ant_*":
  n_steps: 400
"""


@pytest.fixture
def conf(tmp_path):
    path = tmp_path / "cpo.yml"
    path.write_text(FILE)
    return str(path)


@pytest.mark.parametrize(
    ("env_id", "n_steps"),
    [
        ("Goal_Point_8Hazards-v0", 200),
        ("Bare_Name-v0", 300),
        ("Goal_Ant_8Hazards-v0", 400),
        ("Anything-v3", 100),
    ],
)
def test_entry_of_the_environment_else_default(conf, env_id, n_steps):
    assert read_hyperparams("cpo", env_id, conf)["n_steps"] == n_steps


@pytest.mark.parametrize("algo", ["cpo", "sac_lag"])
def test_safety_gymnasiums_tasks_have_its_limit(algo):
    values = read_hyperparams(algo, "SafetyPointGoal1-v0")
    assert values["cost_limit"] == 25.0
    check(algo, ALGORITHMS[algo], values)


def test_the_longest_pattern_wins():
    values = read_hyperparams("cpo", "SafetyRacecarGoal1-v0")
    assert values.pop("env_kwargs") == {"robot": {"scaled": True}}
    assert values == read_hyperparams("cpo", "SafetyPointGoal1-v0")


def test_command_line_wins(conf):
    values = read_hyperparams("cpo", "Anything-v0", conf, {"n_steps": 7, "gamma": 0.9})
    assert values == {"gamma": 0.9, "n_steps": 7, "n_timesteps": 1e5}


def test_python_file_and_module(tmp_path, monkeypatch):
    (tmp_path / "my_conf.py").write_text("hyperparams = {'default': {'n_steps': 5}}")
    monkeypatch.syspath_prepend(tmp_path)
    for name in (str(tmp_path / "my_conf.py"), "my_conf"):
        assert read_hyperparams("cpo", "X-v0", name) == {"n_steps": 5}


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("default: [1, 2", "can't read .*: .*line 1"),
        ("n_steps: 100\n", "must map environments"),
        ("Goal_Point_8Hazards-v0: {}\n", "no entry for 'Goal_Point_8Hazard'.*did you mean"),
    ],
)
def test_files_that_are_not_hyperparameters(tmp_path, content, message):
    path = tmp_path / "bad.yml"
    path.write_text(content)
    with pytest.raises(UsageError, match=message) as error:
        read_hyperparams("cpo", "Goal_Point_8Hazard", str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("absent.yml", "can't read hyperparameter file absent.yml: No such file"),
        ("absent.py", "can't read hyperparameters from absent.py: .*"),
    ],
)
def test_absent_file(name, message):
    with pytest.raises(UsageError, match=message):
        read_hyperparams("cpo", "X-v0", name)


def checked(**values):
    return check("cpo", CPO, {"n_timesteps": 100, **values})


def test_arguments_are_the_leafs_and_the_bases():
    names = annotations(CPO)
    assert {"margin_lr", "target_kl", "n_steps", "policy_kwargs"} <= names.keys()
    assert (
        not {"env", "seed", "device", "verbose", "self", "kwargs", "_init_setup_model"}
        & names.keys()
    )


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("n_steps", "1e3", 1000),
        ("n_timesteps", 6e6, 6_000_000),
        ("learning_rate", "1e-3", 0.001),
        ("batch_size", None, None),
        ("cost_limit", 25, 25.0),
        ("cost_limit", [1, 2.5], [1.0, 2.5]),
        ("policy_kwargs", "dict(log_std_init=-1)", {"log_std_init": -1}),
        ("policy_kwargs", "dict(activation_fn=nn.ReLU)", {"activation_fn": "nn.ReLU"}),
    ],
)
def test_values_in_their_proper_type(name, value, expected):
    result = checked(**{name: value})[name]
    assert result == expected and type(result) is type(expected)


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        ("n_steps", "many", "an integer"),
        ("n_steps", True, "an integer"),
        ("gamma", float("nan"), "a number"),
        ("learning_rate", "fast", "a number or a schedule"),
        ("use_sde", 1, "true or false"),
        ("missing_cost", "ignore", "error, zero"),
        ("cost_limit", "low", "a number or a schedule .* or a list"),
        ("cost_keys", "cost", "a list, each item text"),
        ("policy_kwargs", 3, "a mapping or null"),
    ],
)
def test_values_of_the_wrong_type(name, value, allowed):
    with pytest.raises(UsageError, match=rf"hyperparameter: {name} = .*{allowed}"):
        checked(**{name: value})


def test_unknown_name_suggests_the_nearest():
    with pytest.raises(UsageError, match=r"no hyperparameter 'costlimit'; .* 'cost_limit'"):
        checked(costlimit=1)


def test_how_often_to_train_in_episodes():
    """As in RL-Zoo's own files, e.g. that of DDPG."""
    values = check("sac_lag", SACLag, {"n_timesteps": 100, "train_freq": (1, "episode")})
    assert values["train_freq"] == [1, "episode"]  # as a file holds it
    assert model_arguments(values)["train_freq"] == (1, "episode")
    for bad in ([1], ["episode", 1], [1, 2], "episode"):
        with pytest.raises(UsageError, match="an integer or a list of an integer and text"):
            check("sac_lag", SACLag, {"n_timesteps": 100, "train_freq": bad})


def test_training_takes_a_million_steps_unless_somebody_says_otherwise():
    assert check("cpo", CPO, {})["n_timesteps"] == 1_000_000
    for algo in (*ALGORITHMS, *baselines()):
        entry = read_hyperparams(algo, "Goal_Ant_8Hazards-v0")
        assert entry.get("n_timesteps", 1e6) == 1e6


def test_objects_are_made():
    values = checked(
        learning_rate="lin_0.01",
        policy_kwargs="dict(activation_fn=nn.ReLU)",
        policy="stable_baselines3.common.policies.ActorCriticPolicy",
        normalize=True,
        gamma=0.9,
        env_wrapper="gymnasium.wrappers.FlattenObservation",
        env_kwargs="dict(a=1)",
    )
    model = model_arguments(values)
    assert model.keys() == {"learning_rate", "policy_kwargs", "policy", "gamma"}
    assert model["learning_rate"](0.5) == pytest.approx(0.005)
    assert model["policy_kwargs"] == {"activation_fn": nn.ReLU}
    assert model["policy"].__name__ == "ActorCriticPolicy"
    assert normalization(values) == {"gamma": 0.9} and values["env_kwargs"] == {"a": 1}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("dict(net_arch=dict(pi=[64], vf=[-1, 2.5]))", {"net_arch": {"pi": [64], "vf": [-1, 2.5]}}),
        ("dict(a=(1, None), b={'c': [dict(d=True)]})", {"a": (1, None), "b": {"c": [{"d": True}]}}),
        ("dict(optimizer_class=th.optim.RMSprop, t=torch.float32)",
         {"optimizer_class": torch.optim.RMSprop, "t": torch.float32}),
        ("dict()", {}),
    ],
)  # fmt: skip
def test_expressions_are_data_and_classes_of_torch(text, value):
    assert model_arguments(checked(policy_kwargs=text))["policy_kwargs"] == value


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("policy_kwargs", "dict(activation_fn=nn.Rellu)", "can't be evaluated.*Rellu"),
        ("policy_kwargs", "dict(a=open('x', 'w'))", "can't be evaluated.*open.* is not allowed"),
        ("policy_kwargs", "dict(a=th.hub.load)", "th.hub.load is not a class of torch"),
        ("policy_kwargs", "dict([('a', exit())])", r"dict\(.* is not allowed; .*literals"),
        ("monitor_kwargs", "dict(a=[__import__('os')])", "__import__.* is not allowed"),
        ("normalize", "{'a': exit()}", r"exit\(\) is not allowed"),
        ("learning_rate", "lin_fast", "not a schedule"),
        ("policy", "no.such.Policy", "add --gym-packages no.such"),
        ("env_wrapper", "no.such.Wrapper", "add --gym-packages no.such"),
    ],
)
def test_text_that_names_nothing(name, value, message):
    with pytest.raises(UsageError, match=message):
        classes(name, checked(**{name: value})[name]) if name in BASES else model_arguments(
            checked(**{name: value})
        )


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-3", 0.001),
        ("None", None),
        ("{limit:0.4}", {"limit": 0.4}),
        ("dict(num=4, more=dict(a=[1]))", {"num": 4, "more": {"a": [1]}}),
        ("MlpPolicy", "MlpPolicy"),
        ("'quoted'", "quoted"),
        ("dict(activation_fn=nn.ReLU)", {"activation_fn": "nn.ReLU"}),
        ("dict(a=[x])", "dict(a=[x])"),
        ("", ""),
    ],
)
def test_values_on_the_command_line(text, value):
    assert parse_value(text) == value


# The paper's table of hyperparameters, row by row; ... stands for "not used".
PAPER = "paper"
COLUMNS = "trpo trpo_lag trpo_sl trpo_usl trpo_ipo trpo_fac cpo pcpo".split()
TABLE = {
    "gamma": [0.99] * 8,
    "gae_lambda": [0.97] * 8,
    "target_kl": [0.02] * 8,
    "learning_rate": [0.001] * 8,
    "n_critic_updates": [80] * 8,
    "batch_size": [None] * 8,
    "cost_limit": [..., 0, 0, 0, 0, 0, 0, 0],
    "lambda_lr": [..., 0.005, ..., ..., ..., 0.0001, ..., ...],
    "steps": [..., ..., ..., 20, ..., ..., ..., ...],
    "rate": [..., ..., ..., 0.05, ..., ..., ..., ...],
    "warmup": [..., ..., pytest.approx(1 / 3), pytest.approx(1 / 3), ..., ..., ..., ...],
    "t": [..., ..., ..., ..., 0.01, ..., ..., ...],
}


@pytest.mark.parametrize("algo", COLUMNS)
def test_the_papers_preset_is_its_table(algo):
    values = check(algo, ALGORITHMS[algo], read_hyperparams(algo, "Goal_Point_8Hazards-v0", PAPER))
    for row, cells in TABLE.items():
        cell = cells[COLUMNS.index(algo)]
        if cell is ...:
            assert row not in values
        else:
            assert values[row] == cell, row
    epochs, batch, longest = 200, 30_000, 1_000
    assert values["n_envs"] * values["n_steps"] == batch and values["n_steps"] == longest
    for env_id in env_ids("guard"):
        ratio = 5 if env_id.split("_")[1] in ("Ant", "Walker") else 1
        steps = ratio * epochs * batch
        assert read_hyperparams(algo, env_id, PAPER) == {**values, "n_timesteps": steps}


def test_the_paper_has_no_other_algorithm():
    with pytest.raises(UsageError, match=r"-conf paper has no 'ppo'; .*allowed: trpo"):
        read_hyperparams("ppo", "Goal_Point_8Hazards-v0", PAPER)


def test_every_algorithm_has_a_file_and_every_file_an_algorithm():
    files = {path.stem for path in hyperparams_folder().glob("*.yml")} - {"paper"}
    assert set(ALGORITHMS) <= files <= {*ALGORITHMS, *baselines()}
    assert read_file(hyperparams_folder() / "paper.yml").keys() == {"all", *COLUMNS}
    for file in files:
        assert "default" in read_file(hyperparams_folder() / f"{file}.yml")
