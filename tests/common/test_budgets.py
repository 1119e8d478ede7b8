"""Budget wrappers of a whole batch: row i is what the wrapper of one environment makes of it."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from cost_envs import CostPoint
from stable_baselines3.common.env_util import make_vec_env as sb3_make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_guard import CPO, make_vec_env
from sb3_guard.common.budgets import EarlyTermination, MaxCost, RemainingBudget
from sb3_guard.common.vec_budgets import VecEarlyTermination, VecMaxCost, VecRemainingBudget

SUITE = "Goal_Point_8Hazards"
KEYS = ("cost", "cost_hazards")
PAIRS: dict[str, tuple[Any, Any]] = {
    "remaining": (
        partial(RemainingBudget, budget=0.05, discount=0.9, unsafe_reward=-1.0),
        partial(VecRemainingBudget, budget=0.05, discount=0.9, unsafe_reward=-1.0),
    ),
    "early": (partial(EarlyTermination, budget=0.02), partial(VecEarlyTermination, budget=0.02)),
    "max": (partial(MaxCost, cost_keys=KEYS), partial(VecMaxCost, cost_keys=KEYS)),
    "both": (
        lambda env: RemainingBudget(EarlyTermination(env, 0.02), 0.2),
        lambda env: VecRemainingBudget(VecEarlyTermination(env, 0.02), 0.2),
    ),
    "the other way round": (
        lambda env: EarlyTermination(RemainingBudget(env, 0.2), 0.02),
        lambda env: VecEarlyTermination(VecRemainingBudget(env, 0.2), 0.02),
    ),
}


def equal(a: Any, b: Any) -> None:
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            equal(a[key], b[key])
    else:
        np.testing.assert_array_equal(a, b)


def walk(env: Any, n_steps: int = 90) -> list[Any]:
    rng = np.random.default_rng(0)
    seen = [(env.reset(),)]
    for _ in range(n_steps):
        actions = rng.uniform(-1.0, 1.0, (env.num_envs, *env.action_space.shape))
        obs, rewards, dones, infos = env.step(actions.astype(np.float32))
        for info in infos:
            info.get("episode", {}).pop("t", None)
            # what the lone environment says beside what a row does
            info.pop("is_success", None)
        seen.append((obs, rewards, dones, infos))
    return seen


@pytest.mark.parametrize("name", PAIRS)
@pytest.mark.parametrize("flatten", [True, False])
def test_rows_are_what_lone_environments_are(name: str, flatten: bool) -> None:
    one, batch = PAIRS[name]
    common: dict[str, Any] = {"max_episode_steps": 40, "env_kwargs": {"flatten": flatten}}
    common["env_kwargs"]["hazards"] = {"num": 8, "size": 0.6, "keepout": 0.2}
    lone = make_vec_env(SUITE, 3, seed=5, vec_env="dummy", wrapper_class=one, **common)
    rows = batch(make_vec_env(SUITE, 3, seed=5, **common))
    assert lone.observation_space == rows.observation_space
    ended = over = 0
    for a, b in zip(walk(lone), walk(rows), strict=True):
        equal(a[0], b[0])
        if len(a) > 1:
            for i in range(3):
                episode = (a[3][i].pop("episode", None), b[3][i].pop("episode", None))
                assert (episode[0] is None) == (episode[1] is None)
                if episode[0] is not None:
                    ended += 1
                    over += "budget_exceeded" in a[3][i]
                    assert (episode[0]["l"], episode[0]["c"]) == (episode[1]["l"], episode[1]["c"])
                equal(a[3][i], b[3][i])
            equal(a[1:3], b[1:3])
    assert ended >= 6
    assert (over > 0) is (name not in ("remaining", "max"))


def test_others_environments_too_and_their_rewards() -> None:
    """Of a DummyVecEnv: the step that overspends gets the final reward."""

    def walled() -> Any:
        return sb3_make_vec_env(lambda: CostPoint(20, hazard=(-1.0, 0.0)), 2, seed=0)

    env = VecEarlyTermination(walled(), 0.5, final_reward=-3.0)
    env.reset()
    plain = walled()
    plain.reset()
    for _ in range(3):
        actions = np.zeros((2, 2), np.float32)
        obs, rewards, dones, infos = env.step(actions)
        theirs = plain.step(actions)[1]
        over = np.array(["budget_exceeded" in info for info in infos])
        np.testing.assert_allclose(rewards, theirs - 3.0 * over, rtol=1e-6)
        if over.any():
            break
    assert over.any() and (dones == over).all()
    row = int(np.flatnonzero(over)[0])
    assert not np.array_equal(obs[row], infos[row]["terminal_observation"])
    assert env.episode_costs[row] == 0.0


def test_it_belongs_inside_what_keeps_statistics_of_episodes() -> None:
    costly = sb3_make_vec_env(lambda: CostPoint(20, hazard=(-1.0, 0.0)), 2, seed=0)
    env = VecEarlyTermination(VecNormalize(costly), 0.0)
    env.reset()
    with pytest.raises(ValueError, match=r"VecEarlyTermination.*VecNormalize: it belongs inside"):
        env.step(np.zeros((2, 2), np.float32))


def test_algorithms_learn_behind_them() -> None:
    env = VecMaxCost(VecRemainingBudget(make_vec_env(SUITE, 2, seed=0), 5.0))
    model = CPO("MlpPolicy", env, n_steps=20, n_critic_updates=1, cost_keys=("cost_increase",))
    model.learn(80)
    assert model.observation_space.shape == (env.observation_space.shape)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda env: VecRemainingBudget(env, 0.0), "budget=0.0"),
        (lambda env: VecRemainingBudget(env, 1.0, discount=2.0), "discount=2.0"),
        (lambda env: VecEarlyTermination(env, -1.0), "budget=-1.0"),
        (lambda env: VecEarlyTermination(env, 1.0, cost_key="costs").step([[0, 0]]), "'costs'"),
    ],
)
def test_bad_values_are_named(make: Any, message: str) -> None:
    env = make_vec_env(SUITE, 1, seed=0)
    env.reset()
    with pytest.raises(ValueError, match=message):
        make(env)
