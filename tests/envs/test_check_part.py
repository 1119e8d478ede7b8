"""What a user's part promises is checked once, by a call of ``check_part``."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import pytest
from worlds import own_parts

from sb3_guard.envs import Scenario, register_constraint, register_task, registry
from sb3_guard.envs.check_part import check_part
from sb3_guard.envs.observation import Values
from sb3_guard.envs.parameters import PartError
from sb3_guard.envs.part import Constraint, Task


def kind(base, **verbs):
    """A class of parts as a user may write it."""
    return dataclass(type("Odd", (base,), {"__annotations__": {}, **verbs}))


def matrix(self):
    weights = np.random.default_rng(0).normal(size=(9, 3))
    seen = self.sim.robot.frames[1].reshape(-1, 9) @ weights
    return np.abs(seen).sum(axis=1) * (self.sim.steps > 0)


def own_clock(self):
    self.clock = getattr(self, "clock", 0) + (self.sim.steps > 0).any()
    return np.full(self.sim.num_envs, float(self.clock))


def one_stream(self, ids, rngs):
    self.sim.array("odd/luck")[ids] = rngs[0].random(len(ids))


def luck(self):
    return {"luck": Values(self.sim.array("odd/luck")[:, None].copy())}


def moves_what_it_reads(self):
    self.sim.places("goal")[..., 0] += 0.001
    return np.zeros(self.sim.num_envs)


def nothing(self):
    return np.zeros(self.sim.num_envs)


@pytest.mark.parametrize(
    ("verbs", "words"),
    [
        ({"cost": lambda self: 0.0}, r"cost\(\) of odd has shape \(\), expected \(3,\)"),
        ({"cost": lambda self: nothing(self) - 1}, "cost_odd is -1.0: a cost must be at least 0"),
        ({"cost": nothing, "reset": one_stream, "observations": luck}, "draw from rngs"),
        ({"cost": own_clock}, "Odd: "),
        ({"cost": moves_what_it_reads}, "Odd: "),
    ],
)
def test_a_constraint_that_breaks_its_contract(verbs, words):
    with own_parts():
        register_constraint("Odd", kind(Constraint, **verbs))
        with pytest.raises(PartError, match=words):
            check_part(Scenario(constraints={"odd": {}}).build, "Odd")


def test_a_task_is_checked_too():
    wrong = kind(Task, reward=lambda self, before, now: np.zeros((len(now), 1)))
    with own_parts(), pytest.raises(PartError, match=r"reward\(\) of odd has shape \(3, 1\)"):
        register_task("Odd", wrong)
        check_part(Scenario(task="Odd").build)


@pytest.mark.filterwarnings("error")
def test_our_own_parts_keep_the_contract():
    worlds = {n: Scenario(robot="Ant", constraints={n.lower(): {}}) for n in registry.CONSTRAINTS}
    worlds |= {n: Scenario(task=n) for n in registry.TASKS}
    for name, scenario in worlds.items():
        check_part(partial(scenario.build, num_threads=1), name)
