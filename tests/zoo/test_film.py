"""Films say the return and the costs so far, beside their limits."""

import imageio_ffmpeg
import numpy as np
from registered_envs import Filmed
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_guard import SCPO, PPOLag
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.zoo.agents.film import below, caption, filming

KEYS = ("depth", "risk")


def make(model=None, keys=("cost",)):
    """An environment of eight steps an episode in which everything costs, and an agent."""
    options = {"episode_length": 8, "cost_keys": keys, "hazard": (-1.0, 0.0)}
    venv = DummyVecEnv([lambda: Filmed("rgb_array", **options)])
    env = CostMonitor(venv, cost_keys=keys)
    if model is not None:
        model = model("MlpPolicy", env, n_steps=64, batch_size=64, device="cpu", cost_keys=keys)
    env.seed(0)
    env.reset()
    return env, model


def test_the_line_says_return_and_each_cost_beside_its_limit():
    def two_limits(*args, **kwargs):
        return PPOLag(*args, cost_limit=(0.5, 1000.0), **kwargs)

    env, model = make(two_limits, KEYS)
    total, costs = 0.0, np.zeros(2)
    for _ in range(5):
        _, rewards, _, infos = env.step(np.zeros((1, 2)))
        total += rewards[0]
        costs += [infos[0][key] for key in KEYS]
    assert costs[0] > 0.5
    words = f"return {total:z.2f}    depth {costs[0]:.2f} (limit 0.5)    risk {costs[1]:.2f}"
    assert caption(env, model) == f"{words} (limit 1000)"
    for _ in range(3):
        env.step(np.zeros((1, 2)))
    assert caption(env, model).startswith("return 0.00 ")


def test_an_agent_without_limits_and_one_that_limits_the_worst_step():
    none = make()
    worst = make(lambda *args, **kwargs: SCPO(*args, cost_limit=0.1, **kwargs))
    for env, _ in (none, worst):
        costs = [env.step(np.zeros((1, 2)))[3][0]["cost"] for _ in range(3)]
    assert caption(*none).endswith(f"    cost {sum(costs):.2f}")
    assert caption(*worst).endswith(f"    worst step of cost {max(costs):.2f} (limit 0.1)")


def test_a_line_stands_above_the_picture():
    picture = np.full((75, 301, 3), 60, np.uint8)
    shown = below("cost 3.00, limit 2", picture)
    assert shown.shape == (92, 302, 3)
    np.testing.assert_array_equal(shown[16:91, :301], picture)
    assert (shown[:16].min(axis=2) < 150).sum() > 20  # it is written


def test_a_film_has_a_picture_a_step_and_says_how_far_it_is(tmp_path, capsys):
    venv = CostMonitor(DummyVecEnv([lambda: Filmed("rgb_array", episode_length=208)]))
    with filming(venv, None, tmp_path / "film.mp4") as film:
        venv.reset()
        for _ in range(208):
            venv.step(np.zeros((1, 2)))
            film()
    assert imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))[0] == 207
    assert capsys.readouterr().err == "filmed 100 steps\nfilmed 200 steps\n"
