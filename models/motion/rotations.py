"""Rotations: quaternions (w, x, y, z), matrices, Euler angles in radians, and the 6D form.

A rotation maps vectors of the rotated frame to the outer one: v_outer = R v_inner.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

_AXES = {"X": 0, "Y": 1, "Z": 2}
_EULER_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


def multiply(
    a: Float[np.ndarray, "*#batch 4"], b: Float[np.ndarray, "*#batch 4"]
) -> Float[np.ndarray, "*batch 4"]:
    """The product a b: first b, then a."""
    aw, ax, ay, az = np.moveaxis(a, -1, 0)
    bw, bx, by, bz = np.moveaxis(b, -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def conjugate(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """The inverse of a unit quaternion."""
    signs = np.array([1.0, -1.0, -1.0, -1.0], dtype=q.dtype)
    inverse: np.ndarray = q * signs
    return inverse


def rotate(
    q: Float[np.ndarray, "*#batch 4"], vector: Float[np.ndarray, "*#batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Vectors turned by unit quaternions."""
    w, axis = q[..., :1], q[..., 1:]
    t = 2.0 * np.cross(axis, vector)
    return vector + w * t + np.cross(axis, t)


def normalise(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions; zero becomes the identity."""
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    identity = np.array([1.0, 0.0, 0.0, 0.0], dtype=q.dtype)
    return np.where(norm > 1e-12, q / np.maximum(norm, 1e-12), identity)


def slerp(
    a: Float[np.ndarray, "*#batch 4"],
    b: Float[np.ndarray, "*#batch 4"],
    weight: Float[np.ndarray, "*#batch"],
) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions from a (weight 0) to b (weight 1) on the shorter arc (Shoemake 1985)."""
    cosine = (a * b).sum(axis=-1, keepdims=True)
    b = np.where(cosine < 0, -b, b)
    angle = np.arctan2(
        np.linalg.norm(b - a, axis=-1, keepdims=True), np.linalg.norm(b + a, axis=-1, keepdims=True)
    )  # half the angle between a and b, exact for small and large angles
    weight = weight[..., None]
    close = angle < 1e-6
    sine = np.where(close, 1.0, np.sin(2 * angle))
    from_a = np.where(close, 1 - weight, np.sin((1 - weight) * 2 * angle) / sine)
    from_b = np.where(close, weight, np.sin(weight * 2 * angle) / sine)
    return normalise(from_a * a + from_b * b)


def continuous_sign(q: Float[np.ndarray, "T *batch 4"]) -> Float[np.ndarray, "T *batch 4"]:
    """The same rotations, each quaternion with the sign nearer to that of the frame before."""
    flips = np.where((q[1:] * q[:-1]).sum(axis=-1, keepdims=True) < 0, -1.0, 1.0).astype(q.dtype)
    return np.concatenate([q[:1], q[1:] * np.cumprod(flips, axis=0)])


def swing(
    start: Float[np.ndarray, "*#batch 3"], end: Float[np.ndarray, "*#batch 3"]
) -> Float[np.ndarray, "*batch 4"]:
    """The shortest rotation from one direction to another; identity where a length is 0."""
    lengths = np.linalg.norm(start, axis=-1) * np.linalg.norm(end, axis=-1)
    dot = (start * end).sum(axis=-1)
    axis = np.cross(start, end)
    opposite = dot < (1e-12 - 1) * lengths
    if opposite.any():  # any axis across the start direction will do
        across = np.cross(start, np.eye(3)[np.abs(start).argmin(axis=-1)])
        axis = np.where(opposite[..., None], across, axis)
    q = np.concatenate([(lengths + dot)[..., None], axis], axis=-1)
    q[opposite, 0] = 0.0
    degenerate = lengths < 1e-12
    q[degenerate] = (1.0, 0.0, 0.0, 0.0)
    return normalise(q / np.where(degenerate, 1.0, lengths)[..., None])


def to_matrix(q: Float[np.ndarray, "*batch 4"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of unit quaternions."""
    columns = [rotate(q, axis) for axis in np.eye(3, dtype=q.dtype)]
    return np.stack(columns, axis=-1)


def from_matrix(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Unit quaternions with w >= 0 of rotation matrices, stable for every angle (Shepperd 1978)."""
    m = matrix
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    x, y, z = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = (
        m[..., 0, 1] + m[..., 1, 0],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 1, 2] + m[..., 2, 1],
    )
    rows = [  # row i is 4 q_i q: the row of the largest component is far from zero
        [1 + xx + yy + zz, x, y, z],
        [x, 1 + xx - yy - zz, xy, xz],
        [y, xy, 1 - xx + yy - zz, yz],
        [z, xz, yz, 1 - xx - yy + zz],
    ]
    outer = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    best = np.einsum("...ii->...i", outer).argmax(axis=-1)
    q = np.take_along_axis(outer, best[..., None, None], axis=-2)[..., 0, :]
    return normalise(np.where(q[..., :1] < 0, -q, q))


def from_axis_angles(
    angles: Float[np.ndarray, "*batch D"], axes: Sequence[str]
) -> Float[np.ndarray, "*batch 4"]:
    """The product R_axes[0](angles[0]) R_axes[1](angles[1]) ...: the channels of BVH in order."""
    q = np.zeros((*angles.shape[:-1], 4))
    q[..., 0] = 1.0
    for i, axis in enumerate(axes):
        turn = np.zeros_like(q)
        turn[..., 0] = np.cos(angles[..., i] / 2)
        turn[..., 1 + _AXES[axis]] = np.sin(angles[..., i] / 2)
        q = multiply(q, turn)
    return q


def from_rotation_vectors(vectors: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 4"]:
    """Turns about the directions of vectors, by their lengths in radians."""
    half = np.linalg.norm(vectors, axis=-1, keepdims=True) / 2
    return np.concatenate([np.cos(half), np.sinc(half / np.pi) / 2 * vectors], axis=-1)


def to_euler(q: Float[np.ndarray, "*batch 4"], order: str) -> Float[np.ndarray, "*batch 3"]:
    """Angles such that from_axis_angles(angles, order) is the rotation; order is like "ZXY".

    The middle angle lies in [-pi/2, pi/2]; at its ends the third angle is 0.
    """
    if order not in _EULER_ORDERS:
        raise ValueError(f"order: found {order!r}; it must be one of {', '.join(_EULER_ORDERS)}.")
    i, j, k = (_AXES[axis] for axis in order)
    sign = 1.0 if (i + 1) % 3 == j else -1.0
    m = to_matrix(q)
    cosine = np.hypot(m[..., i, i], m[..., i, j])
    locked = cosine < 1e-7
    first = np.where(
        locked,
        np.arctan2(sign * m[..., k, j], m[..., j, j]),
        np.arctan2(-sign * m[..., j, k], m[..., k, k]),
    )
    second = np.arctan2(sign * m[..., i, k], cosine)
    third = np.where(locked, 0.0, np.arctan2(-sign * m[..., i, j], m[..., i, i]))
    return np.stack([first, second, third], axis=-1)


def to_six(matrix: Float[np.ndarray, "*batch 3 3"]) -> Float[np.ndarray, "*batch 6"]:
    """The first two columns of a rotation matrix (Zhou et al. 2019, eq. 15)."""
    return np.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)


def from_six(six: Float[np.ndarray, "*batch 6"]) -> Float[np.ndarray, "*batch 3 3"]:
    """Rotation matrices of 6D values by Gram and Schmidt (Zhou et al. 2019, eq. 16)."""
    x = six[..., :3] / np.maximum(np.linalg.norm(six[..., :3], axis=-1, keepdims=True), 1e-12)
    y = six[..., 3:] - (x * six[..., 3:]).sum(axis=-1, keepdims=True) * x
    y = y / np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-12)
    return np.stack([x, y, np.cross(x, y)], axis=-1)
