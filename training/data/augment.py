"""Variations of training windows that keep them human: time, mirror, yaw, body, sensor noise."""

import numpy as np
from jaxtyping import Bool, Float

from models.motion.skeleton import Skeleton
from models.system import Augmentation

Poses = Float[np.ndarray, "B L J 3"]


def warped_frames(
    num_frames: int, rates: Float[np.ndarray, "B"]
) -> tuple[np.ndarray, Float[np.ndarray, "B L 1 1"]]:
    """Whole frame and fraction at which to sample a clip played faster (rate > 1) or slower."""
    position = rates[:, None] * np.arange(num_frames)
    whole = np.floor(position).astype(np.int64)
    return whole, (position - whole).astype(np.float32)[..., None, None]


def draw_rates(
    fastest: Float[np.ndarray, "B"], *, how: Augmentation, generator: np.random.Generator
) -> Float[np.ndarray, "B"]:
    """Playing rates from ``how.slowest`` to each row's fastest.

    Uniform on a logarithmic scale, so that slower and faster are equally likely.
    """
    return np.asarray(how.slowest * (fastest / how.slowest) ** generator.random(len(fastest)))


def mirror(poses: Poses, skeleton: Skeleton) -> Poses:
    """Poses reflected in the X-Z plane, left and right joints exchanged."""
    reflected = poses * np.array([1, -1, 1], poses.dtype)
    return np.asarray(reflected[:, :, list(skeleton.mirror)])


def rotate(poses: Poses, angles: Float[np.ndarray, "B"]) -> Poses:
    """Poses turned about the world's up axis, radians."""
    cos, sin = (f(angles).astype(poses.dtype)[:, None, None] for f in (np.cos, np.sin))
    x, y, z = poses[..., 0], poses[..., 1], poses[..., 2]
    return np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=-1)


def scale_bones(poses: Poses, factors: Float[np.ndarray, "B J"], parents: tuple[int, ...]) -> Poses:
    """Poses whose bone to joint j is factors[:, j] times as long; the root's path times factor 0.

    Directions are kept. A body that grows takes longer strides, hence the root's factor.
    """
    scaled = poses.copy()
    scaled[:, :, 0] = poses[:, :, 0] * factors[:, None, :1]
    for joint, parent in enumerate(parents):
        if parent >= 0:
            bone = poses[:, :, joint] - poses[:, :, parent]
            scaled[:, :, joint] = scaled[:, :, parent] + bone * factors[:, None, joint, None]
    return scaled


def draw_mirrored(
    count: int, *, how: Augmentation, generator: np.random.Generator
) -> Bool[np.ndarray, "count"]:
    """Which of some windows are to be mirrored: every other one, by chance, or none."""
    return generator.random(count) < 0.5 if how.mirror else np.zeros(count, dtype=bool)


def augment(
    poses: Poses,
    *,
    mirrored: Bool[np.ndarray, "B"],
    how: Augmentation,
    skeleton: Skeleton,
    generator: np.random.Generator,
) -> Poses:
    """A varied copy of windows that already have their playing rate.

    Who knows what else a mirror image changes draws ``mirrored``, as `draw_mirrored` does.
    """
    batch = len(poses)
    poses = poses.copy()
    poses[mirrored] = mirror(poses[mirrored], skeleton)
    if how.yaw:
        poses = rotate(poses, generator.uniform(-np.pi, np.pi, batch))
    if how.body_scale or how.bone_scale:
        factors = _bone_factors(batch, how, skeleton, generator)
        poses = scale_bones(poses, factors, skeleton.parents)
    return poses


def add_sensor_noise(poses: Poses, *, deviation_m: float, generator: np.random.Generator) -> Poses:
    """Windows of which every other one, by chance, has noise on each coordinate of each frame."""
    noise = generator.standard_normal(poses.shape, np.float32)
    noisy = generator.random((len(poses), 1, 1, 1)) < 0.5
    return poses + noise * np.where(noisy, deviation_m, 0.0).astype(np.float32)


def _bone_factors(
    batch: int, how: Augmentation, skeleton: Skeleton, generator: np.random.Generator
) -> Float[np.ndarray, "B J"]:
    body = 1 + how.body_scale * generator.uniform(-1, 1, (batch, 1))
    bones = 1 + how.bone_scale * generator.uniform(-1, 1, (batch, skeleton.num_joints))
    bones = (bones + bones[:, list(skeleton.mirror)]) / 2  # both sides of a body are alike
    bones[:, 0] = 1
    return (body * bones).astype(np.float32)
