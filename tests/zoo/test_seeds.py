"""Runs of different seeds share no episode, and evaluation none with training."""

import numpy as np
import pytest

from sb3_guard.zoo.run.flags import RunFlags
from sb3_guard.zoo.run.make_envs import evaluation_seed, row_seeds
from sb3_guard.zoo.run.run import Run


def test_no_seed_is_drawn_twice():
    training = [one for seed in range(30) for one in row_seeds(seed, 30)]
    evaluation = [evaluation_seed(seed) + i for seed in range(30) for i in range(30)]
    assert len({*training, *evaluation}) == len(training) + len(evaluation)
    assert all(0 <= one < 2**32 for one in training + evaluation)
    assert row_seeds(3, 30)[:5] == row_seeds(3, 5)  # more rows don't change the first


@pytest.mark.parametrize(("algo", "vec_env"), [("cpo", "native"), ("sac", "dummy")])
def test_first_observations_of_seeds_0_and_1_differ(algo, vec_env):
    """With SB3's seed + i, row 1 of seed 0 was row 0 of seed 1."""
    env = {"dummy": "CostPoint-v0", "native": "Goal_Point_8Hazards"}[vec_env]
    firsts = []
    for seed in (0, 1):
        params = {"n_envs": 4, "n_timesteps": 8}
        params |= {"buffer_size": 40} if algo == "sac" else {}
        run = Run.check(
            RunFlags(algo=algo, env=env, seed=seed, device="cpu", hyperparams=params, eval_freq=1,
                     n_eval_envs=4)
        )  # fmt: skip
        training = run.make()
        training.evaluation.eval_env.seed(evaluation_seed(seed))
        firsts += [training.env.reset(), training.evaluation.eval_env.reset()]
        again = Run(run.flags, run.hyperparams).make()
        np.testing.assert_array_equal(again.env.reset(), firsts[-2])
        again.close()
        training.close()
    rows = np.concatenate(firsts)
    assert len(np.unique(rows, axis=0)) == len(rows) == 16
