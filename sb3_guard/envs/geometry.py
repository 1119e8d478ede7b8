"""Where things are, seen from elsewhere: all the broadcasting of the environments lives here.

Every function is elementwise along N, so that row i of a batch and a batch of one agree bit for
bit: no matrix products, whose order of summation may change with the number of rows.

What takes many operations is done on points by coordinate: [3, K, N] instead of [N, K, 3], so that
NumPy's inner loops run along the rows and not along x, y, z, which is several times faster.
"""

import numpy as np

from sb3_guard.envs.types import Array


def by_coordinate(points: Array) -> Array:
    """A copy of points [N, ..., 3] whose first axis is xyz and whose last is the rows."""
    return points.T.copy()


def dot(a: Array, b: Array) -> Array:
    """Inner product over the first axis, of size 2 or 3, of vectors by coordinate."""
    products = a * b
    total = products[0]
    total += products[1]
    if len(products) == 3:
        total += products[2]
    return total


def length(v: Array) -> Array:
    """Euclidean length over the first axis, of size 2 or 3, of vectors by coordinate."""
    return np.sqrt(dot(v, v))


def norm(v: Array) -> Array:
    """Euclidean length of the last axis, of size 2 or 3."""
    return length(v.T).T


def distance(a: Array, b: Array, planar: bool) -> Array:
    """Distance between points whose last axis is xyz, in the plane or in space."""
    size = 2 if planar else 3
    if a.ndim != b.ndim:
        a, b = np.broadcast_arrays(a, b)
    offset = np.subtract(a.T[:size], b.T[:size], order="C")
    return length(offset).T.copy()  # in C order: how sums of it round depends on that


def into_frames(origin: Array, rotation: Array, points: Array, size: int = 3) -> Array:
    """The first ``size`` coordinates of world points in body frames.

    :param origin: positions of the bodies, [N, B, 3] m
    :param rotation: rotations of the bodies, body to world, [N, B, 3, 3]
    :param points: world points by coordinate, [3, K, N] m
    :return: by coordinate, [size, B, K, N] m
    """
    offset = points[:, None] - by_coordinate(origin)[:, :, None]  # [3, B, K, N]
    axes = rotation.transpose(2, 3, 1, 0)[:, :size].copy()  # [3, size, B, N]
    return dot(offset[:, None], axes[..., None, :])


def yaw_quaternion(heading: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a turn about the vertical, [..., 4]."""
    out = np.zeros((*np.shape(heading), 4))
    out[..., 0] = np.cos(heading / 2)
    out[..., 3] = np.sin(heading / 2)
    return out


def segment_distance(start: Array, end: Array, points: Array) -> Array:
    """Distance of points to segments, all by coordinate, in the plane or in space.

    :param start: one end of each segment, [2 or 3, L, N] m
    :param end: the other ends, in the same form
    :param points: [2 or 3, K, N] m
    :return: [L, K, N] m
    """
    along = (end - start)[:, :, None]  # [3, L, 1, N]
    offset = points[:, None] - start[:, :, None]  # [3, L, K, N]
    share = dot(offset, along)
    share /= np.maximum(dot(along, along), 1e-12)
    np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
    offset -= share * along
    return length(offset)


def rotation_matrix(quaternion: Array) -> Array:
    """Rotation matrices, row by row, [N, 9], of unit quaternions (w, x, y, z), [N, 4]."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=-1)
