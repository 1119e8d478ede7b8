"""Lidar and compass against scalar loops written from their formulas."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from sb3_guard.envs import Scenario, geometry
from sb3_guard.envs.constraints import Hazards
from sb3_guard.envs.engine import Engine
from sb3_guard.envs.observation import Compass, Lidar, Scan, Values, compass
from sb3_guard.envs.observer import Observer
from sb3_guard.envs.robots.guard import Point
from sb3_guard.envs.tasks import Goal


def lidar_2d(points, bins, gain, reach, alias):
    """One body, points [K][2] in its frame."""
    out = [0.0] * bins
    for x, y in points:
        d = math.hypot(x, y)
        phi = math.atan2(y, x) % (2 * math.pi)
        width = 2 * math.pi / bins
        k = min(int(phi / width), bins - 1)
        s = math.exp(-gain * d) if reach is None else max(0.0, reach - d) / reach
        out[k] = max(out[k], s)
        if alias:
            share = (phi - k * width) / width
            after, before = (k + 1) % bins, (k - 1) % bins
            out[after] = max(out[after], share * s)
            out[before] = max(out[before], (1 - share) * s)
    return out


def lidar_3d(points, azimuth, elevation, gain, alias):
    """One body, points [K][3] in its frame; bins in order azimuth, elevation."""
    out = [[0.0] * elevation for _ in range(azimuth)]
    for x, y, z in points:
        s = math.exp(-gain * math.sqrt(x * x + y * y + z * z))
        around, up = 2 * math.pi / azimuth, math.pi / elevation
        phi = math.atan2(y, x) % (2 * math.pi)
        psi = math.atan2(z, math.hypot(x, y)) + math.pi / 2
        a = min(int(phi / around), azimuth - 1)
        e = min(int(psi / up), elevation - 1)
        out[a][e] = max(out[a][e], s)
        if alias:
            share = (phi - a * around) / around
            rise = (psi - e * up) / up
            for column, value in (((a + 1) % azimuth, share), ((a - 1) % azimuth, 1 - share)):
                out[column][e] = max(out[column][e], value * s)
            for row, value in ((min(e + 1, elevation - 1), rise), (max(e - 1, 0), 1 - rise)):
                out[a][row] = max(out[a][row], value * s)
    return [value for column in out for value in column]


def by_coordinate(v):
    """[N, B, K, d] as [d, B, K, N]."""
    return v.transpose(3, 1, 2, 0).copy()


@pytest.mark.parametrize("bins", [1, 2, 3, 16])
@pytest.mark.parametrize(("gain", "reach"), [(1.0, None), (0.5, None), (1.0, 2.5)])
@pytest.mark.parametrize("alias", [True, False])
def test_planar_lidar_equals_the_scalar_loop(bins, gain, reach, alias):
    rng = np.random.default_rng(bins)
    v = rng.uniform(-3, 3, (7, 2, 5, 2))
    v[0, 0, :4] = [[1, 0], [0, 1], [-1, 0], [0, -1]]  # on the edges between bins
    v[1, 0, :2] = [[0, 0], [-1, -1e-300]]  # on the spot, and an angle that rounds up to 2 pi
    falloff = "exponential" if reach is None else "linear"
    lidar = Lidar(bins=bins, gain=gain, falloff=falloff, range=reach, alias=alias)

    scan = lidar.scan(by_coordinate(v))[:, :, 0]
    for n, b in np.ndindex(7, 2):
        np.testing.assert_allclose(
            scan[n, b], lidar_2d(v[n, b].tolist(), bins, gain, reach, alias), atol=1e-12
        )


@pytest.mark.parametrize("alias", [True, False])
@pytest.mark.parametrize(("azimuth", "elevation"), [(10, 6), (1, 1), (4, 3), (5, 1), (2, 2)])
def test_spatial_lidar_equals_the_scalar_loop(azimuth, elevation, alias):
    rng = np.random.default_rng(1)
    v = rng.uniform(-3, 3, (6, 3, 4, 3))
    v[0, 0, :3] = [[0, 0, 2], [0, 0, -2], [0, 0, 0]]  # the poles, and on the spot
    lidar = Lidar(azimuth=azimuth, elevation=elevation, alias=alias)
    scan = lidar.scan(by_coordinate(v))[:, :, 0]
    for n, b in np.ndindex(6, 3):
        want = lidar_3d(v[n, b].tolist(), azimuth, elevation, 1.0, alias)
        np.testing.assert_allclose(scan[n, b], want, atol=1e-12)


def test_the_words_on_a_lidar_say_where_an_object_shows():
    place = np.array([math.cos(math.radians(40)), math.sin(math.radians(40)), 0.1])
    for planar, words, at in (
        (True, "azimuths from 22.5 i to 22.5 (i + 1) degrees, from x towards y", 1),
        (False, "; elevations from 30 j - 90 to 30 (j + 1) - 90; at 6 i + j", 6 * 1 + 3),
    ):
        lidar = Lidar(alias=False, gain=2.0)
        said = lidar.described(planar)
        assert said["bins"].endswith(words) and said["closeness"] == "exp(-2 d)"
        v = place[: 2 if planar else 3]
        seen = lidar.scan(by_coordinate(v[None, None, None]))[0, 0, 0]
        assert seen[at] == seen.max() == pytest.approx(math.exp(-2 * np.linalg.norm(v)))


def test_lidar_of_nothing_is_empty():
    scan = Lidar().scan(np.zeros((2, 1, 0, 3)))
    assert scan.shape == (3, 1, 1, 16) and not scan.any()


def test_compass_equals_the_formula_and_is_zero_on_the_spot():
    v = np.array([[3.0, 4.0], [0.0, 0.0], [-1e-3, 0.0]])
    np.testing.assert_allclose(
        compass(v.T).T, [[3 / 5.001, 4 / 5.001], [0, 0], [-1e-3 / 2e-3, 0]], atol=1e-15
    )


def test_points_in_frames_equal_the_matrix_product():
    rng = np.random.default_rng(2)
    rotation = np.linalg.qr(rng.normal(size=(4, 2, 3, 3)))[0]
    origin, points = rng.normal(size=(4, 2, 3)), rng.normal(size=(4, 5, 3))
    by_axis = geometry.into_frames(origin, rotation, geometry.by_coordinate(points))
    got = by_axis.transpose(3, 1, 2, 0)
    for n, b, k in np.ndindex(4, 2, 5):
        want = rotation[n, b].T @ (points[n, k] - origin[n, b])
        np.testing.assert_allclose(got[n, b, k], want, atol=1e-14)
    flat = geometry.into_frames(origin, rotation, geometry.by_coordinate(points), 2)
    np.testing.assert_array_equal(flat, by_axis[:2])


def test_distance_to_segments():
    start = np.array([[[0.0, 0, 0], [1, 3, 0]]]).T  # the second one has no length
    end = np.array([[[2.0, 0, 0], [1, 3, 0]]]).T
    points = np.array([[[1.0, 3, 4], [-3, 0, 4], [5, 4, 0], [1, 0, 0]]]).T
    got = geometry.segment_distance(start, end, points)[..., 0]
    np.testing.assert_allclose(got, [[5, 5, 5, 0], [4, np.sqrt(41), np.sqrt(17), 3]])
    flat = geometry.segment_distance(start[:2], end[:2], points[:2])[..., 0]
    np.testing.assert_allclose(flat, [[3, 3, 5, 0], [0, 5, np.sqrt(17), 3]])


def test_turns_by_quaternion_and_by_matrix_agree():
    headings = np.array([0.0, 0.3, -2.0])
    matrices = geometry.rotation_matrix(geometry.yaw_quaternion(headings)).reshape(3, 3, 3)
    for heading, matrix in zip(headings, matrices, strict=True):
        c, s = math.cos(heading), math.sin(heading)
        np.testing.assert_allclose(matrix, [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-15)


class Eyes:
    """A robot of two lidar bodies, and a part that shows what it is told."""

    name = "eyes"

    def __init__(self, workspace, frames, shown):
        self.workspace, self.frames, self.shown = workspace, frames, shown

    def observations(self):
        return self.shown


def test_many_observations_equal_each_alone():
    """Lidars and compasses, planar and spatial, visible and not, in one pass."""
    rng = np.random.default_rng(0)

    def points(k):
        return rng.uniform(-2, 2, (5, k, 3))

    visible = np.array([True, False, True, True, False])
    shown = {
        "goal": Compass(points(1)[:, 0], planar=False),
        "vases": Scan(points(3), planar=True),
        "fish": Scan(points(4), planar=False),
        "none": Scan(points(0), planar=True),
        "north": Compass(points(1)[:, 0]),
        "lamps": Scan(points(2), planar=True, visible=visible),
        "speed": Values(points(2)[..., 0]),
        "birds": Scan(points(1), planar=False),
    }
    frames = points(2), np.linalg.qr(rng.normal(size=(5, 2, 3, 3)))[0]
    for workspace in ("planar", "spatial"):
        eyes = Eyes(workspace, frames, shown)
        observer = Observer(eyes, [eyes], Lidar())
        together = observer.look(shown)
        assert together.keys() == shown.keys()
        for name, what in shown.items():
            eyes = Eyes(workspace, frames, {name: what})
            lone = Observer(eyes, [eyes], Lidar())
            alone = lone.observe(np.float64)
            assert alone.shape == (5, lone.size)
            np.testing.assert_array_equal(together[name], alone)
        assert not together["lamps"][~visible].any() and together["lamps"][visible].any()
        assert not together["none"].any()
    assert observer.look({}) == {}


@dataclass
class Sparks(Hazards):
    """Hazards that show one more point from the third step on."""

    name = "sparks"

    def observations(self):
        if (self.sim.steps < 2).all():
            return super().observations()
        centers = self.group.centers
        return {"sparks_lidar": Scan(np.concatenate([centers, centers[:, :1]], axis=1), True)}


def test_more_points_may_be_observed_than_at_first():
    def running(constraint):
        engine = Engine(Point(), Goal(), [constraint], num_envs=2)
        for i in range(2):
            engine.seed(i, np.random.default_rng(i))
        engine.reset(np.arange(2))
        engine.observe()
        engine.step(np.zeros((2, 2)))
        return engine

    changing = running(Sparks(num=2))
    expected = running(dataclass(type("Sparks", (Hazards,), {"name": "sparks"}))(num=2))
    for _ in range(2):
        obs = changing.step(np.ones((2, 2))).obs
        np.testing.assert_array_equal(obs, expected.step(np.ones((2, 2))).obs)


def test_components_choose_and_order_what_is_observed():
    names = ["hazards_lidar", "velocimeter", "goal_compass"]
    base = Scenario.parse("Goal_Point_3Hazards")
    engines = [base.build(), base.override(observe={"components": names}).build()]
    for engine in engines:
        engine.seed(0, np.random.default_rng(0))
        engine.reset(np.zeros(1, dtype=int))
    everything, chosen = (engine.observe(np.float64)[0] for engine in engines)
    parts = [everything[engines[0].observation_layout[name]] for name in names]
    np.testing.assert_array_equal(chosen, np.concatenate(parts))
    assert list(engines[1].observation_layout) == list(engines[1].channels) == names
    assert engines[1].observe().dtype == np.float32
    with pytest.raises(ValueError, match=r"no component 'hazard_lidar': .*'hazards_lidar'"):
        base.override(observe={"components": ["hazard_lidar"]}).build()
    for bad in ([], ["gyro", "gyro"], "gyro"):
        with pytest.raises(ValueError, match=r"observe\.components"):
            base.override(observe={"components": bad})
    with pytest.raises(ValueError, match=r"lidar\.range = 3.*linear"):
        base.override(lidar={"range": 3.0})
