"""Stable-Baselines3's contract, for every algorithm: spaces, saving, resuming, errors, silence."""

import copy
import inspect
import pickle
import random
import re
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from cost_envs import SB3_POLICY, CostPoint, RandomCostEnv
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecNormalize,
)

from sb3_guard.algorithms import (
    ALGORITHMS,
    CPO,
    P3O,
    TRPO,
    TRPOFAC,
    TRPOIPO,
    TRPOSL,
    TRPOUSL,
    PPOLag,
    TrustRegion,
)
from sb3_guard.algorithms.common.lagrangian import Lagrangian
from sb3_guard.costs import read_costs

CLASSES = [cls for cls in ALGORITHMS.values() if issubclass(cls, OnPolicyAlgorithm)]
# They take part where rollouts don't matter; more of them is in test_off_policy.py.
OFF_POLICY = [cls for cls in ALGORITHMS.values() if cls not in CLASSES]
EVERY = [*CLASSES, *OFF_POLICY]
TRUST_REGION = [cls for cls in CLASSES if issubclass(cls, TrustRegion)]


# One of each base and kind of state; the others are slow.
SOME = ("CPO", "SCPO", "TRPOFAC", "TRPOSL", "PPOLag")


PAIR = (CPO, ALGORITHMS["sac_lag"])  # of each kind of experience
FILTERED = (TRPOSL, TRPOUSL)
BOX = spaces.Box(-1.0, 1.0, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (36, 36, 1), np.uint8)


def narrow() -> dict[str, Any]:
    """Networks for off-policy algorithms, which take a step of SB3's wide ones at every step."""
    return {"policy_kwargs": {"net_arch": [16]}}  # SB3 writes into it


def small(cls: type[TrustRegion], env: Any, policy: str = "MlpPolicy", **kwargs: Any) -> Any:
    defaults: dict[str, Any] = {"seed": 0, "device": "cpu", "cost_limit": 0.0}
    if cls in OFF_POLICY:
        defaults |= {"learning_starts": 20, "buffer_size": 300, "batch_size": 8, **narrow()}
        kwargs.pop("n_critic_updates", None)
    else:
        defaults["n_steps"] = 40
    if issubclass(cls, PPO):
        # Whole rollouts: none here is larger than this.
        defaults |= {"n_epochs": kwargs.pop("n_critic_updates", 3), "batch_size": 10_000}
    elif cls not in OFF_POLICY:
        defaults["n_critic_updates"] = 3
    if cls in FILTERED:
        # Switched on after the first rollout, whatever its length: by then it has learnt something.
        defaults["warmup"] = 1
    return cls(policy, env, **{**defaults, **kwargs})


def points(n_envs: int = 2, **kwargs: Any) -> VecEnv:
    return make_vec_env(lambda: CostPoint(**{"episode_length": 30, **kwargs}), n_envs, seed=0)


def parameters(model: Any) -> dict[str, Any]:
    return copy.deepcopy(model.get_parameters())


def assert_equal(a: Any, b: Any) -> None:
    """Nested state dicts, bit for bit."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_equal(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_equal(x, y)
    elif isinstance(a, th.Tensor):
        assert th.equal(a, b)
    else:
        assert a == b


# Spaces and networks; scripts/run_sb3_tests.py runs SB3's own tests of them


@pytest.mark.parametrize("cls", EVERY)
def test_spaces_that_an_algorithm_cannot_train_on_are_named(cls: Any) -> None:
    one = spaces.Discrete(3, start=-1)
    for observed, acting in (BOX, one), (spaces.Dict(a=BOX, b=one), BOX):
        env = make_vec_env(lambda o=observed, a=acting: RandomCostEnv(o, a), 2)
        named = f"must begin at 0|continuous actions|{cls.__name__} corrects"
        with pytest.raises(ValueError, match=named):
            small(cls, env, "MlpPolicy" if observed is BOX else "MultiInputPolicy")
    if cls in FILTERED or cls in OFF_POLICY:
        env = make_vec_env(lambda: RandomCostEnv(BOX, spaces.Discrete(3)), 2)
        with pytest.raises(ValueError, match=r"actions of a Box|continuous actions"):
            small(cls, env)


@pytest.mark.parametrize("cls", PAIR)
def test_dictionaries_are_saved_and_loaded(cls: Any, tmp_path: Path) -> None:
    space = spaces.Dict({"a": BOX, "b": spaces.Discrete(3)})
    env = make_vec_env(lambda: RandomCostEnv(space, BOX), 2, seed=0)
    model = small(cls, env, "MultiInputPolicy").learn(160)
    observation = env.reset()
    action, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    again = cls.load(tmp_path / "model", device="cpu")
    np.testing.assert_array_equal(again.predict(observation, deterministic=True)[0], action)
    assert_equal(parameters(model), parameters(again))


class Frozen(BaseFeaturesExtractor):
    """Somebody's pretrained layers."""

    def __init__(self, space: spaces.Box) -> None:
        super().__init__(space, 8)
        self.layer = th.nn.Linear(space.shape[0], 8).requires_grad_(False)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layer(observations)


@pytest.mark.parametrize("cls", [CPO, PPOLag, *OFF_POLICY])
def test_frozen_layers_stay(cls: Any) -> None:
    kwargs: Any = {"net_arch": [8], "features_extractor_class": Frozen}
    model = small(cls, points(), cost_limit=0.1, policy_kwargs=kwargs)
    before = parameters(model)["policy"]
    after = parameters(model.learn(160))["policy"]
    layers = {name for name in before if ".layer." in name}
    moved = {name for name in before if not th.allclose(before[name], after[name], rtol=1e-6)}
    assert layers and moved and not layers & moved


@pytest.mark.parametrize(("cls", "critic"), [(CPO, "vf"), (ALGORITHMS["sac_lag"], "qf")])
def test_layers_of_the_cost_critic(cls: type[Any], critic: str) -> None:
    """Those of "cost" in ``net_arch``, or of the reward's critic."""

    def widths(module: th.nn.Module) -> set[int]:
        return {width for weights in module.parameters() for width in weights.shape}

    arch: dict[str, list[int]] = {"pi": [11], critic: [17]}
    model = small(cls, points(), policy_kwargs={"net_arch": {**arch, "cost": [19]}})
    assert 19 in widths(model.cost_critic) and 17 not in widths(model.cost_critic)
    assert 17 in widths(model.policy) and 19 not in widths(model.policy)
    model = small(cls, points(), policy_kwargs={"net_arch": arch})
    assert 17 in widths(model.cost_critic)


@pytest.mark.parametrize("cls", [*PAIR, TRPOSL])
def test_networks_of_costs_follow_the_schedule_of_the_learning_rate(cls: Any) -> None:
    model = small(cls, points(), learning_rate=lambda remaining: 1e-4 + 1e-3 * remaining).learn(160)
    owner = model.policy.action_filter if cls is TRPOSL else model.cost_critic
    rate = model.lr_schedule(model._current_progress_remaining)
    assert owner.optimizer.param_groups[0]["lr"] == rate < 1e-3


# Environments


@pytest.mark.parametrize(
    ("n_envs", "episode_length", "n_steps"),
    [(3, 10**6, 20), (1, 30, 40), (2, 45, 20), (2, 1, 10)],
)
def test_episodes_and_rollouts_of_any_length(
    n_envs: int, episode_length: int, n_steps: int
) -> None:
    """One env, no episode ever ending, episodes longer than a rollout, episodes of one step."""
    model = small(CPO, points(n_envs, episode_length=episode_length), n_steps=n_steps)
    model._warned = {"no episode"}
    model.learn(4 * n_envs * n_steps)
    numbers = [v for v in model.logger.name_to_value.values() if isinstance(v, int | float)]
    assert np.isfinite(numbers).all()
    steps = 4 * n_steps
    np.testing.assert_array_equal(model.costs.episodes.lengths, steps % episode_length)
    assert len(model.costs.latest) == min(100, n_envs * (steps // episode_length))


@pytest.mark.parametrize("cls", PAIR)
def test_episode_costs_are_sums_of_raw_costs_across_rollouts(cls: type[TrustRegion]) -> None:
    model = small(cls, points(2, episode_length=40))
    steps: list[list[float]] = []

    def record(local: dict, _: dict) -> bool:
        steps.append([info["cost"] for info in local["infos"]])
        return True

    model.learn(400, callback=record)
    costs = np.array(steps)  # [200, 2]
    sums = costs.reshape(5, 40, 2).sum(axis=1)
    np.testing.assert_allclose(np.array(model.costs.latest)[:, 0], sums.ravel(), rtol=1e-9)
    assert model.total_cost == pytest.approx(costs.sum())


@pytest.mark.parametrize("cls", [CPO, ALGORITHMS["scpo"]])
def test_vec_normalize_leaves_costs_raw(cls: type[TrustRegion], tmp_path: Path) -> None:
    raw: list[float] = []

    def record(local: dict, _: dict) -> bool:
        raw.extend(info["cost"] for info in local["infos"])
        return True

    env = VecNormalize(points(2, cost_scale=1000.0, hazard=(-1.0, 0.0)))
    model = small(cls, env)
    kept = {}
    train = model.train

    def spy() -> None:
        kept["costs"] = model.rollout_buffer.costs.copy()
        train()

    model.train = spy
    model.learn(80, callback=record)
    costs = np.array(raw).reshape(40, 2)
    if cls.limit_on == "max":  # what each step adds to the highest before it, in each episode
        for episode in (costs[:30], costs[30:]):
            peaks = np.maximum.accumulate(episode)
            episode[:] = np.diff(peaks, axis=0, prepend=0.0)
    np.testing.assert_allclose(kept["costs"][..., 0], costs, rtol=1e-5, atol=1e-9)
    assert np.mean(raw) > 50.0
    del model.train
    model.save(tmp_path / "model")
    cls.load(tmp_path / "model", env=env, device="cpu").learn(80)


# Costs in info


class _Info(CostPoint):
    """Reports what it is told to."""

    def __init__(self, report: dict[str, Any]) -> None:
        super().__init__(episode_length=10)
        self.report = report

    def step(self, action: np.ndarray) -> Any:
        *rest, _ = super().step(action)
        return (*rest, dict(self.report))


def info_env(**report: Any) -> VecEnv:
    return DummyVecEnv([lambda: _Info(report)])


@pytest.mark.parametrize("cost", [1, True, np.float32(1), np.array(1.0)])
def test_numbers_of_any_kind_are_costs(cost: Any) -> None:
    model = small(CPO, info_env(cost=cost)).learn(40)
    assert model.total_cost == 40.0


@pytest.mark.parametrize("cost", [np.nan, "1.5", None, [1.0, 2.0]])
def test_anything_else_is_not(cost: Any) -> None:
    with pytest.raises(ValueError, match=r"info\['cost'\] of environment 0.* is .*finite number"):
        small(CPO, info_env(cost=cost)).learn(40)
    with pytest.raises(ValueError, match=r"info\['b'\] of environment 1 is .*finite number"):
        read_costs([{"a": 1.0, "b": 2}, {"a": 1.0, "b": cost}], ("a", "b"), False)


def test_a_missing_cost_is_an_error_that_says_how_to_go_on() -> None:
    with pytest.raises(ValueError) as caught:
        small(CPO, info_env(costs=1.0)).learn(40)
    message = str(caught.value)
    for part in ("'cost'", "'costs'", "nearest", "cost_keys", "missing_cost='zero'"):
        assert part in message


def test_a_missing_cost_may_mean_zero() -> None:
    with pytest.warns(UserWarning, match="no info had a cost key") as record:
        model = small(CPO, info_env(), missing_cost="zero").learn(120)
    assert len([w for w in record if "no info had" in str(w.message)]) == 1
    assert model.total_cost == 0.0


class _WithoutInfos(VecEnvWrapper):
    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        *rest, _ = self.venv.step_wait()
        return (*rest, [])


def test_no_infos_at_all_are_no_costs() -> None:
    env = _WithoutInfos(points(2, episode_length=10**6))
    assert small(TRPO, env).learn(80).num_timesteps == 80
    with pytest.raises(ValueError, match=r"environment 0.* has no cost key 'cost'"):
        small(CPO, env).learn(80)


def test_trpo_needs_no_cost_and_says_nothing(recwarn: pytest.WarningsRecorder) -> None:
    model = small(TRPO, info_env()).learn(80)
    assert not [w for w in recwarn if "cost" in str(w.message)]
    assert not [key for key in model.logger.name_to_value if "cost" in key]
    with pytest.raises(ValueError, match="no cost key"):
        small(TRPO, info_env(), missing_cost="error").learn(40)


# Bad values


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"cost_gamma": 2.0}, "cost_gamma = 2.0 must be"),
        ({"target_kl": 0.0}, "target_kl = 0.0 must be greater than 0"),
        ({"missing_cost": "ignore"}, "missing_cost = 'ignore': allowed: error, zero"),
        ({"cost_keys": "cost"}, r"cost_keys='cost'.*sequence"),
        ({"cost_keys": ("a", "a")}, "different names"),
        ({"cost_limit": [1.0, 2.0]}, r"cost_limit=\[1.0, 2.0\].*one for each of the 1"),
        ({"cost_limit": "low"}, "cost_limit='low'"),
    ],
)
def test_bad_values_are_named(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(CPO, points(1), **kwargs)


def test_without_a_limit_it_says_what_that_means(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="(PPOLag|CPO) without cost_limit: it is 0") as record:
        PPOLag("MlpPolicy", points(), n_steps=40, batch_size=80).save(tmp_path / "model")
        PPOLag.load(tmp_path / "model")
        PPOLag("MlpPolicy", points(), n_steps=40, batch_size=80, cost_limit=0.0)
        TRPO("MlpPolicy", points(), n_steps=40)
        CPO("MlpPolicy", points(), n_steps=40)
    assert len(record) == 2


def test_a_limit_set_later_is_the_limit() -> None:
    model = small(TRPOFAC, points(2, hazard=(-1.0, 0.0)), n_critic_updates=1)
    for limit in (2.0, [7]):
        model.cost_limit = limit
        model.learn(80)
        excess = model.costs.episode_cost - np.ravel(limit)
        np.testing.assert_allclose(model.costs.violation, excess / 30)
    model.cost_limit = -3
    with pytest.raises(ValueError, match="cost_limit=-3: must be at least 0; a negative limit"):
        model.learn(80)
    with pytest.raises(ValueError, match=r"cost_limit=\[-0.5\]: must be at least 0"):
        small(TRPO, points(1), cost_limit=[-0.5])


# Saving, loading, resuming


@pytest.mark.parametrize("cls", CLASSES)
def test_save_and_load_keep_everything(cls: type[TrustRegion], tmp_path: Path) -> None:
    keys = ("cost", "cost_1")
    env = points(2, cost_keys=keys, hazard=(-1.0, 0.0))
    model = small(cls, env, cost_keys=keys, cost_limit=(1.0, 2.0), target_kl=0.013)
    model.learn(200)
    model.save(tmp_path / "model")
    again = cls.load(tmp_path / "model", env=env, device="cpu")
    assert_equal(parameters(model), parameters(again))
    for name in (
        "target_kl",
        "num_timesteps",
        "total_cost",
        "missing_cost",
        "cost_keys",
    ):
        assert getattr(model, name) == getattr(again, name), name
    for name in ("limits", "total", "last", "episode_cost", "horizon"):
        pair = [getattr(each.costs, name) for each in (model, again)]
        np.testing.assert_array_equal(*pair, err_msg=name)
    np.testing.assert_array_equal(np.array(model.costs.latest), np.array(again.costs.latest))
    if cls.uses_cost_critic:
        observation = th.randn(5, 4)
        assert th.equal(
            model.cost_critic.predict(observation), again.cost_critic.predict(observation)
        )
    if cls in FILTERED:
        assert model.policy.corrects and again.policy.corrects
        assert model.policy.action_filter.optimizer.state
    observation = env.reset()
    for state in (None, (np.full((2, 2), 0.3),)):
        actions = [
            each.predict(observation, state, deterministic=True)[0] for each in (model, again)
        ]
        np.testing.assert_array_equal(*actions)
    again.learn(80, reset_num_timesteps=False)
    assert again.num_timesteps == model.num_timesteps + 80


@pytest.mark.parametrize("cls", PAIR)
def test_load_with_another_number_of_envs(cls: type[TrustRegion], tmp_path: Path) -> None:
    small(cls, points(2), n_critic_updates=1).learn(80).save(tmp_path / "model")
    model = cls.load(tmp_path / "model", env=points(3), device="cpu")
    model.learn(120, reset_num_timesteps=False)
    assert model.costs.episodes.totals.shape == (3, 1) and model.num_timesteps == 200


class _Checkpoint(BaseCallback):
    """At the start of a rollout keep the model, the env and the generators, as a file would."""

    def __init__(self, path: Path, at: int) -> None:
        super().__init__()
        self.path, self.at = path, at
        self.rest: Any = None

    def _on_rollout_start(self) -> None:
        if self.num_timesteps == self.at:
            self.model.save(self.path)
            env = pickle.dumps([wrapped.unwrapped for wrapped in self.training_env.envs])
            legacy = np.random.get_state()  # noqa: NPY002
            self.rest = pickle.dumps((env, (random.getstate(), legacy, th.get_rng_state())))

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("cls", "kwargs"),
    [
        (CPO, {"batch_size": 16}),
        *(
            pytest.param(cls, {}, marks=() if cls.__name__ in SOME else pytest.mark.slow)
            for cls in CLASSES
        ),
    ],
)
def test_resumed_equals_uninterrupted(
    cls: type[TrustRegion], kwargs: dict[str, Any], tmp_path: Path
) -> None:
    """Bit for bit: networks, optimizers, counters, running episodes, logs."""

    def env(envs: list[gym.Env] | None = None) -> VecEnv:
        made = envs or [CostPoint(episode_length=33, hazard=(-1.0, 0.0)) for _ in range(2)]
        return DummyVecEnv([lambda each=each: each for each in made])

    def learn(model: Any, steps: int, **more: Any) -> Any:
        return model.learn(steps, **more)

    checkpoint = _Checkpoint(tmp_path / "model", at=160)
    schedule = {"learning_rate": lambda remaining: 1e-3 * remaining + 1e-4}
    whole = small(cls, env(), **kwargs, **schedule)
    learn(whole, 400, callback=checkpoint)

    envs, generators = pickle.loads(checkpoint.rest)
    resumed_env = env(pickle.loads(envs))
    resumed = cls.load(tmp_path / "model", env=resumed_env, device="cpu", force_reset=False)
    python, numpy, torch = generators
    random.setstate(python)
    np.random.set_state(numpy)  # noqa: NPY002
    th.set_rng_state(torch)
    for each, state in zip(resumed_env.envs, pickle.loads(envs), strict=True):
        each.__dict__.update(state.__dict__)
    learn(resumed, 400 - 160, reset_num_timesteps=False)

    assert resumed.num_timesteps == whole.num_timesteps == 400
    assert_equal(parameters(whole), parameters(resumed))
    assert whole.total_cost == resumed.total_cost
    np.testing.assert_array_equal(whole.costs.episodes.totals, resumed.costs.episodes.totals)
    np.testing.assert_array_equal(whole.costs.episodes.lengths, resumed.costs.episodes.lengths)
    np.testing.assert_array_equal(np.array(whole.costs.latest), np.array(resumed.costs.latest))
    for key, value in whole.logger.name_to_value.items():
        if key.startswith(("train/", "rollout/")):
            assert resumed.logger.name_to_value[key] == value, key


# Logging


class _Dumps(BaseCallback):
    """Keeps what each dump contained."""

    def __init__(self) -> None:
        super().__init__()
        self.dumps: list[dict[str, Any]] = []

    def _on_training_start(self) -> None:
        dump = self.logger.dump

        def spy(step: int = 0) -> None:
            self.dumps.append(dict(self.logger.name_to_value))
            dump(step)

        self.logger.dump = spy  # type: ignore[method-assign]

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize("cls", TRUST_REGION)
def test_a_leaf_is_its_problem_and_its_hooks(cls: type[TrustRegion]) -> None:
    """It names its paper, states its problem in a block, and replaces hooks and set-up alone."""
    doc = inspect.getdoc(cls)
    first, _, rest = doc.partition("\n\n")
    assert re.search(r"\bet al\., \d{4}.*\d{4}\.\d{5}\)", first)
    assert rest.startswith("::\n")
    hooks = {"advantages", "surrogate", "plan", "correct", "fit", "critic_rows", "value_rollout"}
    set_up = {"__init__", "_check_hyperparameters", "_setup_model", "_get_torch_save_params"}
    base = {name for layer in cls.__mro__[1:] for name in vars(layer)}
    replaced = {name for name, value in vars(cls).items() if callable(value) and name in base}
    first = {"train"} if issubclass(cls, Lagrangian) else set()  # the multipliers follow J_C
    assert replaced <= hooks | set_up | first


@pytest.mark.parametrize(("name", "meant"), [("cost_limt", "cost_limit"), ("nsteps", "n_steps")])
def test_an_unknown_argument_is_answered_with_the_nearest(name: str, meant: str) -> None:
    with pytest.raises(TypeError, match=f"CPO takes no argument '{name}'; did you mean '{meant}'"):
        CPO("MlpPolicy", points(1), **{name: 5})
    with pytest.raises(TypeError, match="CPO takes no argument 'ent_coef'"):
        CPO("MlpPolicy", points(1), ent_coef=0.1)
    with pytest.raises(TypeError, match=f"CPO takes no argument '{name}'; did you mean '{meant}'"):
        CPO.load("unread", **{name: 5})


@pytest.mark.parametrize("cls", ALGORITHMS.values())
def test_the_signature_says_what_can_be_passed_by_position(cls: Any) -> None:
    stated = inspect.signature(cls).parameters.values()
    names = [one.name for one in stated if one.kind is one.POSITIONAL_OR_KEYWORD]
    values = {name: inspect.signature(cls).parameters[name].default for name in names[2:]}
    more = {"learning_rate": 1.5e-4, "gamma": 0.91, "n_steps": 1 if "tau" in values else 40}
    more |= {"batch_size": 16} if values["batch_size"] else {}
    values |= {name: value for name, value in more.items() if name in values}
    values.pop("_init_setup_model", None)
    model = cls("MlpPolicy", points(1), *values.values())
    for name in {"learning_rate", "gamma", "n_steps", "batch_size", "n_epochs"} & values.keys():
        assert getattr(model, name) == values[name], name
    with pytest.raises(TypeError, match="'learning_rate'"):
        cls("MlpPolicy", points(1), 3e-4, learning_rate=1e-4)


SB3_KEYS = {
    "rollout/ep_rew_mean",
    "rollout/ep_len_mean",
    "time/fps",
    "time/total_timesteps",
    "train/value_loss",
    "train/explained_variance",
    "train/std",
    "train/n_updates",
    "train/learning_rate",
    "train/policy_objective",
    "train/kl",
    "train/line_search_step",
    "rollout/ep_cost_mean",
    "rollout/cost_rate",
}


@pytest.mark.parametrize(
    ("cls", "own"),
    [
        (TRPO, set()),
        (CPO, {"cpo_case", "nu", "lambda_kl", "cost_margin", "cost_value_loss", "cost_surrogate",
               "cost_change", "cost_change_promised", "constraint_violation"}),
        (TRPOSL, {"corrected_fraction", "correction_norm", "cost_model_loss", "cost_model_error",
                  "constraint_violation"}),
    ],
)  # fmt: skip
def test_logs(cls: type[TrustRegion], own: set[str]) -> None:
    callback = _Dumps()
    model = small(cls, points(2, hazard=(-1.0, 0.0))).learn(240, callback=callback)
    dump = callback.dumps[-1]
    assert SB3_KEYS <= set(dump)
    if cls.constrained:
        assert dump["rollout/cost_limit"] == model.cost_limit
    logged = {key for key in dump if key.startswith("train/")}
    theirs = {key for key in SB3_KEYS if key.startswith("train/")}
    assert logged == theirs | {f"train/{name}" for name in own}
    assert dump["rollout/ep_cost_mean"] == pytest.approx(np.mean(model.costs.latest))
    assert dump["rollout/cost_rate"] == pytest.approx(model.total_cost / model.num_timesteps)


@pytest.mark.parametrize("cls", [TRPOIPO, P3O])
def test_until_something_costs_the_reward_alone_is_learnt(cls: Any) -> None:
    """At a limit of 0 too: a cost critic that has met no cost says nothing."""
    settings = {"n_steps": 40, "seed": 0, "device": "cpu"}
    plain = PPO if cls is P3O else TRPO
    base: dict[str, Any] = {"n_critic_updates": 3}
    if cls is P3O:
        base = {"batch_size": 40, "gae_lambda": 0.9, "target_kl": None, "policy_kwargs": SB3_POLICY}
    weights = []
    for one, limit in ((plain, {}), (cls, {"cost_limit": 0.0})):
        model = one("MlpPolicy", points(cost_scale=0.0), **settings, **base, **limit).learn(240)
        weights.append(th.cat([value.flatten() for value in model.policy.parameters()]))
    th.testing.assert_close(*weights, rtol=0.0, atol=1e-6)
