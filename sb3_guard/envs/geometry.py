"""Where things are, seen from elsewhere: all the broadcasting of the environments lives here.

Every function is elementwise along N, so that row i of a batch and a batch of one agree bit for
bit: no matrix products, whose order of summation may change with the number of rows.
"""

from __future__ import annotations

import numpy as np

Array = np.ndarray


def norm(v: Array) -> Array:
    """Euclidean length of the last axis, of size 2 or 3."""
    total = v[..., 0] * v[..., 0] + v[..., 1] * v[..., 1]
    if v.shape[-1] == 3:
        total = total + v[..., 2] * v[..., 2]
    return np.sqrt(total)


def distance(a: Array, b: Array, planar: bool) -> Array:
    """Distance between points whose last axis is xyz, in the plane or in space."""
    return norm(a[..., :2] - b[..., :2]) if planar else norm(a - b)


def into_frames(origin: Array, rotation: Array, points: Array, size: int = 3) -> Array:
    """The first ``size`` coordinates of world points in body frames.

    :param origin: positions of the bodies, [N, B, 3] m
    :param rotation: rotations of the bodies, body to world, [N, B, 3, 3]
    :param points: world points, [N, K, 3] m
    :return: [N, B, K, size] m
    """
    offset = points[:, None] - origin[:, :, None]  # [N, B, K, 3]
    axes = rotation[:, :, None, :, :size]  # [N, B, 1, 3, size]
    out = offset[..., 0:1] * axes[..., 0, :]  # [N, B, K, size]
    out += offset[..., 1:2] * axes[..., 1, :]
    out += offset[..., 2:3] * axes[..., 2, :]
    return out


def yaw_quaternion(heading: Array) -> Array:
    """Unit quaternion (w, x, y, z) of a turn about the vertical, [..., 4]."""
    out = np.zeros((*np.shape(heading), 4))
    out[..., 0] = np.cos(heading / 2)
    out[..., 3] = np.sin(heading / 2)
    return out


def segment_distance(start: Array, end: Array, points: Array) -> Array:
    """Distance of points to segments.

    :param start: one end of each segment, [N, L, 3] m
    :param end: the other end, [N, L, 3] m
    :param points: [N, K, 3] m
    :return: [N, L, K] m
    """
    along = (end - start)[:, :, None]  # [N, L, 1, 3]
    offset = points[:, None] - start[:, :, None]  # [N, L, K, 3]
    length2 = along[..., 0] ** 2 + along[..., 1] ** 2 + along[..., 2] ** 2
    dot = (
        offset[..., 0] * along[..., 0]
        + offset[..., 1] * along[..., 1]
        + offset[..., 2] * along[..., 2]
    )
    t = np.clip(dot / np.maximum(length2, 1e-12), 0.0, 1.0)
    return norm(offset - t[..., None] * along)


def rotation_matrix(quaternion: Array) -> Array:
    """Rotation matrices, row by row, [N, 9], of unit quaternions (w, x, y, z), [N, 4]."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return np.stack(rows, axis=-1)
