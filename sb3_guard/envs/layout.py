"""Where things stand when an episode begins: clear places for discs of given radii.

The rule is GUARD's: two objects keep at least the sum of their keep-outs between their centres,
and a centre keeps its own keep-out from the border of its rectangle. GUARD draws blindly and
starts over whenever one object finds no room, which for ten wide objects in a small arena takes
hundreds of restarts. Here an object that finds no room among 128 draws takes the place where it
disturbs the fewest others, and those are drawn again. This is quick, but favours some layouts: with
``restarts``, a layout starts over first.
"""

import functools
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from sb3_guard.envs.parameters import Parameters, param
from sb3_guard.envs.types import Array
from sb3_guard.errors import WorldError

Rectangle = tuple[float, float, float, float]
StartOver = Callable[[Array, Array, Array, bool], Array | None]

AWAY = (1e6, 1e6, 0.0)  # m: where objects are that an episode is without, out of sight and reach
DRAWS = 128
PATIENCE = 4000  # placements, or 4 of each object, before a layout is called impossible


@dataclass(frozen=True)
class Layout(Parameters):
    """Options of where things are that belong to no part."""

    name = "layout"

    placements: tuple[Rectangle, ...] = param(
        (),
        "rectangles (x low, y low, x high, y high) that parts without their own are drawn in, m; "
        "empty: the arena",
    )
    margin: float = param(0.0, "extra distance between any two objects, m", low=0)
    order: tuple[str, ...] = param(
        (), "what is placed first, such as [robot, goal]; the others follow: task, constraints"
    )
    restarts: int = param(
        0,
        "layouts begun anew where an object finds no room, before others make room for it; the "
        "distribution is then that of blind draws, object by object",
        low=0,
        high=10**6,
    )
    overlap: bool = param(False, "whether keep-outs may let solid objects begin inside each other")


class LayoutError(WorldError, RuntimeError):
    """No clear layout was found; the message names the crowded part."""


@dataclass(frozen=True)
class Footprint:
    """What one group of like objects needs of the floor.

    :param name: whose places these are
    :param num: how many objects
    :param keepout: radius kept clear of others' radii, m
    :param placements: rectangles (x low, y low, x high, y high) to draw from, m; empty: the arena's
    :param locations: fixed places, (x, y) m, for the first objects of the group
    :param margin: extra distance to every other object, m; of two margins the greater counts
    :param height: z, m, or a range to draw z from, after x and y
    :param reach: greatest distance of (x, y, z) from ``reach_center``, m
    :param reach_center: the point that the robot's reach is measured from, (x, y, z) m
    :param hand: places of the robot's hand, [n, 3] m, one of which each centre is, or nearly
    :param mover: whether it moves by itself, so that a new goal may ignore it in need
    :param redrawn: whether the first object is drawn again within an episode
    :param last: whether it is also drawn again once everything else has its place
    :param cover: radius around its place that a solid object never leaves, m
    :param label: what messages call its keep-out
    :param among: places, (x, y) m, of which each centre is one, in place of ``placements``
    """

    name: str
    num: int
    keepout: float
    placements: tuple[Rectangle, ...] = ()
    locations: tuple[tuple[float, float], ...] = ()
    margin: float = 0.0
    height: float | tuple[float, float] = 0.0
    reach: float = math.inf
    reach_center: tuple[float, float, float] = (0.0, 0.0, 0.0)
    hand: Array | None = field(default=None, compare=False)
    mover: bool = False
    redrawn: bool = False
    last: bool = False
    among: tuple[tuple[float, float], ...] = ()
    cover: float = 0.0
    label: str = "keepout"

    def __post_init__(self) -> None:
        drawn = (len(self.locations) < self.num or self.redrawn) and not self.among
        for r in self.placements:
            if len(r) != 4 or not (r[0] < r[2] and r[1] < r[3]):
                raise ValueError(
                    f"{self.name}: a placement must be (x low, y low, x high, y high), got {r}"
                )
            if min(r[2] - r[0], r[3] - r[1]) < 2 * self.keepout and drawn:
                raise ValueError(
                    f"{self.name}: keepout {self.keepout} does not fit the placement {r}; "
                    "make the placement larger or the keepout smaller"
                )
        if len(self.locations) > self.num:
            raise ValueError(
                f"{self.name}: {len(self.locations)} locations for {self.num} objects; "
                "give at most one each"
            )
        *center, z = self.reach_center
        best = float(np.clip(z, *self._range))
        for place in self.locations or self.among or (center,):
            gap = math.dist((*place, best), self.reach_center)
            if gap > self.reach:
                where = f"location {place}" if self.locations or self.among else "height"
                raise ValueError(
                    f"{self.name}: {where} is out of the robot's reach: {gap:.2f} m from "
                    f"{self.reach_center} even at the best height, {best} m; it reaches "
                    f"{self.reach} m"
                )
        if self.hand is not None and self.placements and not len(self._spots):
            raise ValueError(
                f"{self.name}: the robot's hand gets to no place in {list(self.placements)} at "
                f"heights {self.height}: widen placements or height"
            )

    @functools.cached_property
    def _room(self) -> tuple[Array, Array, Array]:
        """Low corners [n, 2] and spans [n, 2] of where centres may be, m, and their shares [n]."""
        boxes = np.array(self.placements)
        low = boxes[:, :2] + self.keepout
        span = np.maximum(boxes[:, 2:] - self.keepout - low, 0.0)
        area = span[:, 0] * span[:, 1] + 1e-12
        return low, span, area / area.sum()

    @functools.cached_property
    def _spots(self) -> Array:
        """Places of the hand, moved a little into placements and heights, [n, 3] m."""
        (low, span, _), (bottom, top), hand = self._room, self._range, np.asarray(self.hand)
        corners = zip(low, low + span, strict=True)
        moved = np.array([np.clip(hand, (*a, bottom), (*b, top)) for a, b in corners])
        return moved[np.linalg.norm(moved - hand, axis=2) <= self.reach / 15]

    def draw(self, rng: np.random.Generator, n: int) -> Array:
        """``n`` uniform centres, [2, n] m, or places of the hand."""
        if self.among:
            return np.array(self.among).T[:, rng.integers(len(self.among), size=n)]
        if self.hand is not None:
            return self._spots[rng.integers(len(self._spots), size=n), :2].T
        low, span, share = self._room
        if len(low) > 1:
            which = rng.choice(len(low), size=n, p=share)
            low, span = low[which], span[which]
        draws: Array = np.multiply(rng.random((n, 2)).T, span.T, order="C")
        draws += low.T
        return draws

    def elevate(self, rng: np.random.Generator, xy: Array) -> Array:
        """Heights for centres [n, 2]: [n] m, within reach."""
        low, high = (np.full(len(xy), z) for z in self._range)
        if not isinstance(self.height, tuple):
            return low
        if math.isfinite(self.reach):
            x, y, z = self.reach_center
            dx, dy = xy[:, 0] - x, xy[:, 1] - y
            room = np.sqrt(np.maximum(self.reach**2 - dx**2 - dy**2, 0.0))
            low = np.maximum(low, z - room)
            high = np.maximum(np.minimum(high, z + room), low)
        if self.hand is None:
            return low + rng.random(len(xy)) * (high - low)
        gaps = np.linalg.norm(self._spots[:, :2] - xy[:, None], axis=2)  # 0 where it was drawn
        return np.clip(self._spots[gaps.argmin(axis=1), 2], low, high)

    @property
    def _range(self) -> tuple[float, float]:
        return self.height if isinstance(self.height, tuple) else (self.height, self.height)

    def out_of_reach(self, draws: Array) -> Array:
        """Which centres, [2, ...] m, leave no height within reach, [...] bool."""
        x, y, z = self.reach_center
        dx, dy = draws[0] - x, draws[1] - y
        return dx**2 + dy**2 > self.reach**2 - (np.clip(z, *self._range) - z) ** 2


@functools.lru_cache
def first(footprint: Footprint, num: int) -> Footprint:
    """The footprint of the first ``num`` of its objects."""
    return replace(footprint, num=num, locations=footprint.locations[:num])


def arrange(
    footprints: Sequence[Footprint],
    rng: np.random.Generator,
    start_over: StartOver | None = None,
) -> dict[str, Array]:
    """Draw a clear layout.

    :param footprints: what to place, in order
    :param rng: the only source of randomness
    :param start_over: gives a whole layout, see :meth:`sb3_guard.envs.restarts.Restarts.draw`; if
        it gives none, others make room for an object that finds no room
    :return: centres by footprint name, [num, 3] m
    :raises LayoutError: no layout was found, naming the part that found no room most often
    """
    owner = [f for f in footprints for _ in range(f.num)]
    keepout = np.array([f.keepout for f in owner])
    margin = np.array([f.margin for f in owner])
    gaps = keepout[:, None] + keepout + np.maximum(margin[:, None], margin)  # [K, K] m
    apart = gaps[..., None] ** 2
    xy = np.full((2, len(owner), 1), np.inf)  # what is not yet placed is out of everyone's way
    fixed = np.zeros(len(owner), dtype=bool)
    k = 0
    for f in footprints:
        for j, place in enumerate(f.locations):
            xy[:, k + j, 0], fixed[k + j] = place, True
        k += f.num
    given = xy.copy()
    queue = deque(np.flatnonzero(~fixed).tolist())
    layout = None if start_over is None else start_over(apart, given, fixed, False)
    if layout is not None:
        xy, queue = layout, deque()
    weight = np.where(fixed, 1.0 + len(owner), 1.0)  # what a clash with each is worth
    failures: dict[str, int] = {}
    for _ in range(max(PATIENCE, 4 * len(owner))):
        if not queue:
            break
        k = queue.popleft()
        f = owner[k]
        draws = f.draw(rng, DRAWS)
        clash = square_distance(draws, xy) < apart[k]  # [K, DRAWS]
        trouble = weight @ clash
        if math.isfinite(f.reach):
            trouble += len(owner) ** 2 * f.out_of_reach(draws)
        best = int(trouble.argmin())  # the first clear draw, else the least disturbing one
        if trouble[best] > 0:
            if start_over is not None and not failures:
                layout = start_over(apart, given, fixed, True)
                if layout is not None:
                    xy, queue = layout, deque()
                    break
            failures[f.name] = failures.get(f.name, 0) + 1
            if trouble[best] >= len(owner):
                queue.append(k)
                continue
            for ejected in clash[:, best].nonzero()[0].tolist():
                xy[:, ejected] = np.inf
                queue.append(ejected)
        xy[:, k, 0] = draws[:, best]
    if queue:
        crowded = max(failures, key=lambda name: failures[name])
        raise _no_room(next(f for f in footprints if f.name == crowded))
    return _centres(footprints, xy, rng)


def _centres(
    footprints: Sequence[Footprint], xy: Array, rng: np.random.Generator
) -> dict[str, Array]:
    """The centres of a layout by footprint name, [num, 3] m, with heights and last places drawn."""
    out, k = {}, 0
    for f in footprints:
        centres = xy[:, k : k + f.num, 0].T
        out[f.name] = np.column_stack([centres, f.elevate(rng, centres)])
        k += f.num
    for f in footprints:
        if f.last:
            drawn = redraw(f, {g: out[g.name] for g in footprints if g is not f}, rng)
            if drawn is None:
                raise LayoutError(f"{f.name} finds no room once everything else has its place")
            out[f.name][0] = drawn
    return out


def _no_room(f: Footprint) -> LayoutError:
    """What to raise where a part found no room most often."""
    within = f" within {f.reach} m of {f.reach_center}" if math.isfinite(f.reach) else ""
    return LayoutError(
        f"{f.name} cannot be placed: {f.num} with keepout {f.keepout} m find no room in "
        f"{list(f.placements)}{within} in addition to the other parts: reduce num or keepout, its "
        "own or another's, or widen placements or height"
    )


def square_distance(draws: Array, xy: Array) -> Array:
    """Squared distances, [K, ...] m², of [2, ...] draws to [2, K, ...] places."""
    offset = draws[:, None] - xy
    offset *= offset
    square: Array = offset[0]
    square += offset[1]
    return square


def check_covers(footprints: Sequence[Footprint]) -> None:
    """Refuse keep-outs that let solid objects begin inside each other.

    :raises ValueError: names the least that is allowed
    """
    for f in footprints:
        if f.keepout < f.cover - 1e-9:  # rounding
            least = math.ceil(1000 * f.cover - 1e-6) / 1000
            raise ValueError(
                f"{f.label} = {f.keepout!r} lets solid objects begin inside each other: it "
                f"must be at least {least:g}; leave it out for what covers them, or set "
                "layout={'overlap': True}"
            )


def redraw(
    footprint: Footprint,
    others: Mapping[Footprint, Array],
    rng: np.random.Generator,
    tries: int = 80,
) -> Array | None:
    """Draw one object again among others that stand where they stand.

    Movers are ignored when nothing is free with them.

    :param footprint: what to place; its first object
    :param others: the current centres [num, 3] m of every other footprint
    :param tries: batches of 128 draws
    :return: the new centre, [3] m, or None if there is no room
    """
    for movers in (True, False):
        rest = [(f, p) for f, p in others.items() if movers or not f.mover]
        xy = np.concatenate([np.zeros((0, 2)), *(p[:, :2] for _, p in rest)]).T[..., None]
        gaps = [
            footprint.keepout + f.keepout + max(footprint.margin, f.margin)
            for f, _ in rest
            for _ in range(f.num)
        ]
        apart = np.array(gaps)[:, None] ** 2  # [K, 1] m²
        for _ in range(tries):
            draws = footprint.draw(rng, DRAWS)
            clear = ~(square_distance(draws, xy) < apart).any(axis=0)
            if math.isfinite(footprint.reach):
                clear &= ~footprint.out_of_reach(draws)
            if clear.any():
                place = draws[:, clear.argmax()][None]
                return np.append(place[0], footprint.elevate(rng, place)[0])
    return None
