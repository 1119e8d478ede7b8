"""One set of defaults: the command, ``make_model`` and the class train the same agent."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import registered_envs  # noqa: F401  an environment with an id
import torch as th
from cost_envs import CostPoint
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_guard import ALGORITHMS, make_model, make_vec_env, train
from sb3_guard.algorithms import CostReplay
from sb3_guard.envs import Scenario
from sb3_guard.zoo.cli.names import classes
from sb3_guard.zoo.cli.usage import UsageError
from sb3_guard.zoo.run.algos import baselines
from sb3_guard.zoo.run.hyperparams import (
    RUN_KEYS,
    action_noise,
    check,
    merged,
    model_arguments,
    normalization,
    parameters,
    read_hyperparams,
)
from sb3_guard.zoo.run.make_envs import seed_rows

ENVS = ["SafetyPointGoal1-v0", "Goal_Point_8Hazards-v0"]
FOREIGN = "CliffWalking-v1"  # an id that has no entry
#: Entries hold what depends on the environment: its limit, the shape of rollouts, wrappers …
OF_THE_ENVIRONMENT = {*RUN_KEYS, "policy", "policy_kwargs", "cost_limit", "n_steps", "batch_size"}
OF_THE_ENVIRONMENT |= {"noise_type", "noise_std", "learning_starts", "train_freq", "gradient_steps"}
OF_THE_ENVIRONMENT |= {"buffer_size", "aim"}  # what a command trains is certified
#: … and where robots need other values than known optima.
DEPARTURES = {
    ("trpo_lag", ENVS[0]): {
        "cost_gae_lambda", "lambda_lr", "proportional_gain", "limit_start", "limit_fall",
    },
    ("trpo_lag", ENVS[1]): {"cost_gae_lambda"},
    **{("trpo_ipo", env): {"cost_gae_lambda"} for env in ENVS},
    **{
        (algo, env): {"lambda_lr"}
        for algo in ("ppo_lag", "cppo_pid", "focops")
        for env in ENVS
    },
    **{("cup", env): {"n_epochs", "projection_reach"} for env in ENVS},
    ("sac_lag", ENVS[0]): {"limit_start", "safety_margin"},
    ("sac_lag", ENVS[1]): {"lambda_lr"},
    **{(algo, env): {"lambda_lr"} for algo in ("td3_lag", "tqc_lag") for env in ENVS},
    **{
        ("trpo_fac", env): {
            "mode", "cost_gae_lambda", "lambda_ascent", "lambda_lr", "lambda_epochs",
            "lambda_init", "proportional_gain", "trace",
        }
        for env in ENVS
    },
}  # fmt: skip
#: One of each kind: a rollout, minibatches, a multiplier of its own, a filter, a replay buffer
QUICK = {(algo, ENVS[0]) for algo in ("ppo_lag", "trpo_fac", "trpo_usl", "sac_lag")}
QUICK.add(("cpo", ENVS[1]))
SEED, ROLLOUT, N_ENVS = 3, 100, 4


@pytest.mark.parametrize("env_id", [*ENVS, FOREIGN])
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_entries_hold_only_what_depends_on_the_environment(algo: str, env_id: str) -> None:
    values, known = read_hyperparams(algo, env_id), parameters(ALGORITHMS[algo])
    assert values.get("policy_kwargs", {}).keys() <= {"net_arch", "optimizer_kwargs"}
    beside = values.keys() - OF_THE_ENVIRONMENT
    assert beside == DEPARTURES.get((algo, env_id), set())
    assert all(values[name] != known[name].default for name in beside)  # else it can go


def shortened(algo: str) -> dict[str, Any]:
    """What makes an update short."""
    if issubclass(ALGORITHMS[algo], CostReplay):
        return {"n_envs": N_ENVS, "learning_starts": 360, "buffer_size": 10_000}
    return {"n_envs": N_ENVS, "n_steps": ROLLOUT}


def weights(model: Any) -> dict[str, np.ndarray]:
    """All that ``save`` keeps of networks and optimizers."""
    arrays: dict[str, np.ndarray] = {}
    for name, state in model.get_parameters().items():
        entries = state.items() if isinstance(state, dict) else [("", state)]
        for key, value in entries:
            if isinstance(value, th.Tensor):
                arrays[f"{name}.{key}"] = value.detach().numpy().copy()
    return arrays


@pytest.mark.parametrize(
    ("algo", "env_id"),
    [
        pytest.param(algo, env_id, marks=() if (algo, env_id) in QUICK else pytest.mark.slow)
        for algo in ALGORITHMS
        for env_id in ENVS
    ],
)
def test_command_function_and_class_train_the_same_agent(
    algo: str, env_id: str, tmp_path: Path
) -> None:
    cls, entry = ALGORITHMS[algo], read_hyperparams(algo, env_id)
    short, steps = shortened(algo), ROLLOUT * N_ENVS
    params = [f"{name}:{value}" for name, value in short.items()]
    assert not train.main(
        ["--algo", algo, "--env", env_id, "-n", str(steps), "--seed", str(SEED), "--verbose", "0",
         "--eval-freq", "-1", "--device", "cpu", "-f", str(tmp_path), "-params", *params]
    )  # fmt: skip
    trained = weights(cls.load(tmp_path / algo / f"{env_id}_1" / f"{env_id}.zip"))

    model = make_model(algo, env_id, seed=SEED, device="cpu", **short)
    begun = weights(model)
    made = weights(model.learn(steps))

    env = make_vec_env(env_id, N_ENVS)
    values = check(algo, cls, {**entry, **short})
    for wrapper, arguments in classes("vec_env_wrapper", values.get("vec_env_wrapper")):
        env = wrapper(env, **arguments)
    if (scaled := normalization(values)) is not None:
        env = VecNormalize(env, **scaled)
    noise = action_noise(values, env.action_space)
    extra = {} if noise is None else {"action_noise": noise}
    model = cls(env=env, seed=SEED, device="cpu", **model_arguments(values), **extra)
    seed_rows(env, SEED)
    by_class = weights(model.learn(steps))

    assert trained.keys() == made.keys() == by_class.keys()
    for name, array in trained.items():
        np.testing.assert_array_equal(array, made[name], err_msg=name)
        np.testing.assert_array_equal(array, by_class[name], err_msg=name)
    assert any(not np.array_equal(array, begun[name]) for name, array in trained.items())


def test_make_model_takes_what_a_file_cannot_hold() -> None:
    model = make_model(
        "cpo",
        "Goal_Point_2Hazards",
        cost_limit=3,
        n_envs=2,
        n_steps=20,
        learning_rate=lambda left: 1e-3 * left,
        policy_kwargs={"activation_fn": nn.ReLU},
        env_kwargs={"hazards": {"size": 0.2}},
        seed=0,
    )
    assert (model.cost_limit, model.n_envs, model.lr_schedule(0.5)) == (3.0, 2, 5e-4)
    assert model.policy.activation_fn is nn.ReLU and (model.policy.log_std == -0.5).all()
    (scenario,) = model.get_env().get_attr("scenario", 0)
    assert scenario.constraints["hazards"]["size"] == 0.2


def test_make_model_takes_a_class_or_a_function() -> None:
    kwargs: dict[str, Any] = {"cost_limit": 3.0, "seed": 1, "n_envs": 2, "n_steps": 30}
    kwargs["env_kwargs"] = {"episode_length": 20}
    agents = []
    for made in "CostPoint-v0", CostPoint, lambda **kwargs: CostPoint(**kwargs):
        model = make_model("cpo", made, **kwargs).learn(60)
        agents.append(th.cat([weights.flatten() for weights in model.policy.parameters()]))
    assert all(th.equal(agents[0], agent) for agent in agents)
    assert model.costs.horizon == 20.0
    for name in "CostPoint", "SafetyRacecarOfMine":  # which no pattern of a file means
        mine = type(name, (CostPoint,), {"__module__": "mine"})
        with pytest.raises(ValueError, match=rf"no cost limit is known for mine\.{name}: give"):
            make_model("cpo", mine)
    with pytest.raises(ValueError, match=r"can.t make cost_envs\.CostPoint: "):
        make_model("cpo", CostPoint, cost_limit=1.0, env_kwargs={"size": 2})
    for env, name in (
        (CostPoint(), r"lambda: CostPoint\(...\)"),
        (gym.make("CostPoint-v0"), "'CostPoint-v0'"),
    ):
        with pytest.raises(TypeError, match=f"made already: give its id or a function .* {name}"):
            make_model("cpo", env)


def test_arguments_of_a_part_join_those_of_the_file() -> None:
    """A Racecar's actions are scaled in the file, also where a user changes something else."""
    small: dict[str, Any] = {"n_envs": 2, "n_steps": 20, "seed": 0}
    changed = {"robot": {"keepout": 0.5}}
    model = make_model("cpo", "SafetyRacecarGoal1-v0", env_kwargs=changed, **small)
    (scenario,) = model.get_env().get_attr("scenario", 0)
    assert scenario.robot_params["keepout"] == 0.5 and model.action_space.high.max() == 1.0
    assert merged({"hazards": {"num": 4}, "a": 1}, {"hazards": None}) == {"hazards": None, "a": 1}
    scenario = Scenario(robot="SafetyRacecar", task="Goal")
    model = make_model("cpo", scenario, cost_limit=1.0, **small)
    assert model.action_space.high.max() == 20.0


def test_sizes_of_a_file_are_not_warned_of(tmp_path) -> None:
    """Minibatches of 64 leave a smaller one at the end of a rollout of 20,000 steps."""
    (tmp_path / "my.yml").write_text("default: {n_envs: 20, n_steps: 1000, batch_size: 64}")
    file = str(tmp_path / "my.yml")
    with warnings.catch_warnings(action="error"):
        make_model("ppo_lag", "Goal_Point_8Hazards", conf=file, cost_limit=2.0, seed=0)
    with pytest.warns(UserWarning, match="mini-batch size of 64"):
        make_model("ppo_lag", "Goal_Point_8Hazards", conf=file, cost_limit=2.0, n_steps=999, seed=0)


@pytest.mark.parametrize("algo", ["ppo", "sac", "tqc"])
def test_make_model_makes_baselines(algo: str) -> None:
    model = make_model(algo, "SafetyPointGoal1", n_envs=2)
    assert type(model) is baselines()[algo]
    if algo in ("ppo", "sac"):
        assert (model.get_vec_normalize_env() is not None) == (algo == "ppo")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (("cp", "Goal_Point_8Hazards", {}), "unknown algorithm 'cp'; did you mean 'cpo'"),
        (("cpo", "Goal_Point_8Hazards", {"costlimit": 1}), "did you mean 'cost_limit'"),
        (("p3o", "Goal_Point_8Hazards", {"cost_limit": -1.0}), "must be at least 0"),
        (("cpo", "Goal_Point_8Hazards", {"callback": "x"}), "'callback'; give it to model.learn"),
        (("cpo", "Goal_Point_8Hazards", {"device": "cuda:99"}), "^device 'cuda:99' is not allowed"),
        (("cpo", "Goal_Point_8Hazards", {"seed": "x"}), "seed"),
        (("cpo", "CartPole-v1", {}), "no cost limit is known for CartPole-v1: give cost_limit"),
    ],
)
def test_make_model_refuses_in_a_line(call: tuple[str, str, dict[str, Any]], message: str) -> None:
    algo, env_id, kwargs = call
    with pytest.raises(ValueError, match=message) as error:
        make_model(algo, env_id, **kwargs)
    assert "\n" not in str(error.value) and not isinstance(error.value, UsageError)
