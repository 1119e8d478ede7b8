"""Films say what the agent has earned and paid, beside its limits."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from registered_envs import Filmed
from stable_baselines3.common.vec_env import DummyVecEnv
from tqdm import tqdm

from sb3_guard import SCPO, PPOLag
from sb3_guard.common.monitor import CostMonitor
from sb3_guard.zoo.agents.film import Film, below, filming

KEYS = ("depth", "risk")


def make(model=None, keys=("cost",), bar=None):
    """An environment of eight steps an episode in which everything costs, and what is filmed."""
    options = {"episode_length": 8, "cost_keys": keys, "hazard": (-1.0, 0.0)}
    venv = DummyVecEnv([lambda: Filmed("rgb_array", **options)])
    env = CostMonitor(venv, cost_keys=keys)
    pictures = []
    if model is not None:
        model = model("MlpPolicy", env, n_steps=64, batch_size=64, device="cpu", cost_keys=keys)
    writer = SimpleNamespace(send=pictures.append)
    return Film(env, model, writer, bar or tqdm(disable=True)), pictures


def test_the_line_says_return_and_each_cost_beside_its_limit():
    def two_limits(*args, **kwargs):
        return PPOLag(*args, cost_limit=(0.5, 1000.0), **kwargs)

    film, pictures = make(two_limits, KEYS)
    film.seed(0)
    film.reset()
    earned, costs = 0.0, np.zeros(2)
    for _ in range(5):
        _, rewards, _, infos = film.step(np.zeros((1, 2)))
        earned += rewards[0]
        costs += [infos[0][key] for key in KEYS]
    assert costs[0] > 0.5
    assert film.words() == [
        (f"return {earned:z.2f}", False),
        (f"depth {costs[0]:.2f}, limit 0.5", True),
        (f"risk {costs[1]:.2f}, limit 1000", False),
    ]
    assert len(pictures) == 5 and pictures[0].shape == (80, 64, 3)


def test_an_agent_without_limits_and_one_that_limits_the_worst_step():
    film, _ = make()
    worst, _ = make(lambda *args, **kwargs: SCPO(*args, cost_limit=0.1, **kwargs))
    for each in (film, worst):
        each.seed(0)
        each.reset()
        costs = [each.step(np.zeros((1, 2)))[3][0]["cost"] for _ in range(3)]
    assert film.words()[1] == (f"cost {sum(costs):.2f}", False)
    assert worst.words()[1] == (f"worst cost of a step {max(costs):.2f}, limit 0.1", True)


def test_costs_of_other_names_are_those_of_the_monitor():
    film, _ = make(keys=KEYS)
    film.seed(0)
    film.reset()
    info = film.step(np.zeros((1, 2)))[3][0]
    assert film.words()[1:] == [(f"{key} {info[key]:.2f}", False) for key in KEYS]


def test_the_last_picture_of_an_episode_stays_with_its_totals():
    film, pictures = make()
    film.reset()
    dones = [film.step(np.ones((1, 2)))[2][0] for _ in range(8)]
    assert dones == [False] * 7 + [True]
    assert len(pictures) == 7 + 10  # of ten a second
    for held in pictures[7:]:
        np.testing.assert_array_equal(held[16:], pictures[6][16:])
    assert (film.earned, film.costs.tolist()) == (0.0, [0.0])  # another one begins


def test_a_line_stands_above_the_picture_and_is_red_beyond_the_limit():
    picture = np.full((75, 301, 3), 60, np.uint8)
    for red in (False, True):
        shown = below([("cost 3.00, limit 2", red)], picture)
        assert shown.shape == (92, 302, 3)
        np.testing.assert_array_equal(shown[16:91, :301], picture)
        line = shown[:16].astype(int)
        assert (line.min(axis=2) < 150).sum() > 20  # it is written
        assert ((line[..., 0] - line[..., 1] > 80).sum() > 20) == red


def test_filming_shows_how_far_it_is():
    bar = io.StringIO()
    progress = tqdm(total=8, file=bar, desc="Filming", mininterval=0)
    film, _ = make(bar=progress)
    film.reset()
    for _ in range(4):
        film.step(np.zeros((1, 2)))
    progress.refresh()
    assert "4/8" in bar.getvalue() and "return" in bar.getvalue() and "cost" in bar.getvalue()


@pytest.mark.parametrize("bar, terminal", [(True, True), (True, False), (False, True)])
def test_the_bar_is_on_a_terminal_if_it_is_asked_for(bar, terminal, tmp_path, monkeypatch):
    stderr = io.StringIO()
    stderr.isatty = lambda: terminal
    monkeypatch.setattr("sys.stderr", stderr)
    venv = CostMonitor(DummyVecEnv([lambda: Filmed("rgb_array", episode_length=8)]))
    with filming(venv, None, tmp_path / "film.mp4", bar) as film:
        film.reset()
        for _ in range(3):
            film.step(np.zeros((1, 2)))
    assert (tmp_path / "film.mp4").stat().st_size > 500
    assert ("Filming" in stderr.getvalue()) == (bar and terminal)
