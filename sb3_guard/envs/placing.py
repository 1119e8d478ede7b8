"""Where everything is put when an episode begins, and where the next goal is within one."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from sb3_guard.envs.layout import (
    AWAY,
    Footprint,
    Layout,
    Rectangle,
    arrange,
    check_covers,
    redraw,
)
from sb3_guard.envs.part import Part
from sb3_guard.envs.restarts import Restarts
from sb3_guard.envs.types import Array


class Placing:
    """Draws the places of all that the parts of a world have.

    :param parts: which have been built
    :param layout: options
    :param placements: rectangles of parts without their own, m, unless the options state some
    :param array: gives arrays ``[N, *shape]`` by name, which are part of the engine's state
    :raises ValueError: two parts place one name, or what they place does not go together
    """

    def __init__(
        self,
        parts: Sequence[Part],
        layout: Layout,
        placements: tuple[Rectangle, ...],
        array: Callable[..., Array],
    ) -> None:
        self.footprints: dict[str, Footprint] = {}
        self.owners: dict[str, Part] = {}
        self.places: dict[str, Array] = {}  # [N, num, 3] m each, live
        for part in parts:
            for f in part.footprints():
                if f.name in self.footprints:
                    raise ValueError(
                        f"{part.name} and {self.owners[f.name].name} both place {f.name!r}; "
                        "give the constraint another name"
                    )
                self.footprints[f.name] = replace(
                    f,
                    placements=f.placements or layout.placements or placements,
                    margin=max(f.margin, layout.margin),
                )
                self.owners[f.name] = part
                self.places[f.name] = array(f"places/{f.name}", (f.num, 3))
        order = layout.order
        self._ordered = sorted(  # stable: what is not named keeps its place in the order of parts
            self.footprints.values(),
            key=lambda f: order.index(f.name) if f.name in order else len(order),
        )
        self._restarts = (
            Restarts(self._ordered, layout.restarts, array) if layout.restarts else None
        )
        if not layout.overlap:
            check_covers(list(self.footprints.values()))

    def forget(self, rows: Array | int) -> None:
        """Forget layouts that are kept for later episodes of these rows."""
        if self._restarts is not None:
            self._restarts.forget(rows)

    def draw(self, row: int, rng: np.random.Generator) -> None:
        """Draw a layout for the episode that begins in a row.

        :raises LayoutError: a part finds no room
        """
        present = [self.owners[f.name].present(f, row) for f in self._ordered]
        start_over = None
        if self._restarts is not None:
            start_over = partial(self._restarts.draw, row, rng, present)
        layout = arrange(present, rng, start_over)
        for name, places in layout.items():
            self.places[name][row] = AWAY
            self.places[name][row, : len(places)] = places

    def redraw(self, name: str, row: int, rng: np.random.Generator) -> bool:
        """Draw the first object of footprint ``name`` again in one row.

        It keeps clear of where everything is now; movers are ignored if there is no room otherwise.

        :return: whether a place was found
        """
        others = {
            f: self.owners[f.name].positions(f.name)[row]
            for f in self.footprints.values()
            if f.name != name
        }
        place = redraw(self.footprints[name], others, rng)
        if place is not None:
            self.places[name][row, 0] = place
        return place is not None
