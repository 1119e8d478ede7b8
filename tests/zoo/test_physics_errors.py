"""Episodes that a physics error ended keep no limit and make no best model."""

import json

import gymnasium as gym
import numpy as np
import pytest
from worlds import own_parts

from sb3_guard import CPO, CostEvalCallback, enjoy, evaluate_policy, make_vec_env, plot, train
from sb3_guard.envs import register_robot, registry
from sb3_guard.zoo.results.runs import read_curve
from sb3_guard.zoo.results.statistics import read_splits

NAN = """<mujoco><option gravity="0 0 nan"/><worldbody><body name="base" pos="0 0 .2"><freejoint/>
<geom size=".1"/><body name="leg"><joint name="hip" axis="0 1 0" range="-1 1"/><geom size=".1"/>
</body></body></worldbody><actuator><motor joint="hip" ctrlrange="-1 1"/></actuator></mujoco>"""


class Breaks(gym.Env):
    """Episodes of ten steps, which cost nothing; in ``share`` of them the simulation diverges."""

    def __init__(self, share=0.5):
        self.share, self.steps = share, 0
        self.observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps, self.broken = 0, self.np_random.random() < self.share
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        over = self.steps == 10
        info = {"cost": 0.0} | ({"physics_error": True} if over and self.broken else {})
        return np.zeros(2, np.float32), 1.0, over, False, info


gym.register("Breaks-v0", Breaks)


def run(tmp_path, capfd, share, *more):
    words = ["--algo", "cpo", "--env", "Breaks-v0", "-n", "1200", "--seed", "0"]
    words += ["-f", str(tmp_path), "--env-kwargs", f"share:{share}", "-params", "cost_limit:2"]
    words += ["n_envs:4", "n_steps:100", "--eval-freq", "400", "--eval-episodes", "8", *more]
    status = train.main(words)
    return (status, tmp_path / "cpo" / "Breaks-v0_1", *capfd.readouterr())


def test_what_a_broken_episode_costs_is_not_known():
    env = make_vec_env(Breaks, 2, seed=0)
    model = CPO("MlpPolicy", env, n_steps=50)
    played = evaluate_policy(model, env, 20, seed=0)
    broken = int(np.isnan(played.costs).sum())
    assert 0 < broken < 20 and len(played) == 20
    assert f"cost 0.000 ± 0.000 ({broken} episodes ended in a physics error)" in str(played)
    callback = CostEvalCallback(make_vec_env(Breaks, 2), selection_limit=1.0)
    callback.model = model
    assert not np.isfinite(callback.score(played)[1])
    model.learn(200)  # the algorithm's estimate is of the other episodes
    assert model.costs.episode_cost == 0.0 and np.isfinite(model.costs.horizon)


def test_a_run_counts_them_apart(tmp_path, capfd):
    status, folder, out, _ = run(tmp_path, capfd, 0.5)
    assert status == 0 and not (folder / "best_model.zip").exists()
    result = json.loads((folder / "result.json").read_text())
    cost = result["costs"]["cost"]
    assert cost["limit"] == 2 and cost["physics_errors"] > 0
    assert "limit 2" in out and "episodes ended in a physics error" in out
    assert None in result["final"]["greedy"]["costs"]
    splits = read_splits(folder)
    assert all(0 < split["M_c"].isna().sum() < len(split) for split in splits.values())
    assert not read_curve(folder, 400)["M_c"].isna().any()
    table = tmp_path / "t.md"
    assert plot.main([str(tmp_path), "--table", str(table)]) == 0
    text = table.read_text()
    assert "episodes ended in a physics error" in text
    assert "2: undecided (" in text and "2: kept" not in text
    capfd.readouterr()
    assert enjoy.main(["-f", str(folder), "--n-episodes", "9"]) == 0
    assert "episodes ended in a physics error" in capfd.readouterr()[0]


def test_a_training_of_nothing_else_stops_in_a_line(tmp_path, capfd):
    status, folder, _, err = run(tmp_path, capfd, 1.0)
    assert status == 1 and "episodes all ended in a physics error" in err
    assert len(err.strip().splitlines()) == 1 and not (folder / "result.json").exists()


def test_a_robot_that_diverges_at_rest_is_refused(tmp_path):
    (tmp_path / "nan.xml").write_text(NAN)
    words = "left alone, explodes within 0.02 s: reduce its timestep"
    with own_parts():
        with pytest.raises(ValueError, match=f"robot 'Nan': the robot, {words}"):
            register_robot("Nan", xml=tmp_path / "nan.xml")
        assert "Nan" not in registry.ROBOTS
