"""Parameters that are drawn anew in each episode, and what of the physics follows them.

Each row draws from its own generator when an episode begins, before anything else, and once however
often the layout is drawn. What is not drawn takes no random number.
"""

from __future__ import annotations

import dataclasses
import weakref
from collections.abc import Sequence

import mujoco
import numpy as np

from sb3_guard.envs.part import Part, Simulation, World, below
from sb3_guard.envs.types import Array

# what a factor multiplies: fields of the model
FIELDS = {"mass": ("body_mass", "body_inertia"), "friction": ("pair_friction",)}


class Drawn:
    """What is drawn in a world.

    :param parts: which have been built
    :param world: what they were built into
    :param sim: the engine, whose model has not been compiled
    :param told: whether info says what was drawn
    :raises ValueError: a factor on something that a part does not have
    """

    def __init__(self, parts: Sequence[Part], world: World, sim: Simulation, told: bool) -> None:
        self._sim, self._told = weakref.proxy(sim), told
        self.ranges = {f"{p.name}.{key}": r for p in parts for key, r in p.ranges.items()}
        self.values: dict[str, Array] = {}  # by the same names, [N] each
        for name, (_, high) in self.ranges.items():
            self.values[name] = sim.array(name, dtype=type(high))
            self.values[name][:] = high
        self._factors = [
            (part, f.name, f.metadata["drawn"])
            for part in parts
            for f in dataclasses.fields(part)  # type: ignore[arg-type]
            if f.metadata.get("drawn") in FIELDS and part.span(f.name) != (1.0, 1.0)
        ]
        for part, name, kind in self._factors:
            rubs = sum(map(world.rub, part.roots)) if kind == "friction" else len(part.roots)
            if not rubs:
                lacks = "meets no floor" if kind == "friction" else "has no body that can be pushed"
                raise ValueError(f"{part.name}.{name} has no effect: {part.name} {lacks}")

    def bind(self, model: mujoco.MjModel) -> None:
        """Find out what factors apply to, once parts are bound; set those that stay the same."""
        self._scaled: list[tuple[str, Array, Array]] = []  # field, its rows, factors
        for part, name, kind in self._factors:
            bodies = below(model, part.roots)
            ends = model.geom_bodyid[[model.pair_geom1, model.pair_geom2]]
            rubs = np.isin(ends, bodies).any(axis=0) & (ends == 0).any(axis=0)
            rows = np.array(bodies) if kind == "mass" else np.flatnonzero(rubs)
            self._scaled += [(field, rows, part.current(name)) for field in FIELDS[kind]]
        self._weighs = any(kind == "mass" for *_, kind in self._factors)
        self.apply(np.arange(self._sim.num_envs, dtype=np.int32))

    def draw(self, ids: Array) -> None:
        """Draw what the episodes of rows ``ids``, [n], have."""
        for row in ids.tolist():
            rng = self._sim.rngs[row]
            for name, (low, high) in self.ranges.items():
                whole = isinstance(high, int)
                value = rng.integers(low, high, endpoint=True) if whole else rng.uniform(low, high)
                self.values[name][row] = value
        self.apply(ids)

    def apply(self, ids: Array) -> None:
        """Let the physics of rows ``ids``, [n], follow what was drawn."""
        batch = self._sim.batch
        for field, rows, factors in self._scaled:
            batch.scale(field, rows, ids, factors[ids])
        if self._weighs:
            batch.set_const(ids)

    def info(self) -> dict[str, Array]:
        """What info says of the running episodes, by name, [N] each: nothing if not asked to."""
        return {name: values.copy() for name, values in self.values.items() if self._told}
