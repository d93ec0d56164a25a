"""BVH files: read into metres with +Z up, and written for animation tools."""

from collections.abc import Iterator, Sequence
from io import TextIOBase
from pathlib import Path

import numpy as np
from jaxtyping import Float

from models.motion import rotations as rot
from models.motion.formats.bvh_hierarchy import Joint, read_hierarchy
from models.motion.formats.bvh_rows import frames_per_second, read_counts, read_rows
from models.motion.formats.text import read_lines
from models.motion.guesses import plausible_factor
from models.motion.kinematics import global_rotations
from models.motion.motion import Motion
from models.motion.rig import Rig, rigged
from models.motion.skeleton import Skeleton, resolve_joints

UNITS_M = (0.01, 1.0, 0.001, 0.0254 / 0.45, 0.0254)  # cm, metre, mm, CMU's unit, inch
_ORDER = "ZXY"
_ROTATION_CHANNELS = " ".join(f"{axis}rotation" for axis in _ORDER)
_POSITION_CHANNELS = "Xposition Yposition Zposition"
_TIP = 0.3  # length of an End Site as a part of the bone before it
_LEG_PER_REACH = 0.7  # hip to ankle as a part of the longest chain of bones from the hips


def read_bvh(path: Path, *, scale: float | None = None) -> Motion:
    """The motion of a BVH file: all its joints under their own names, without end sites.

    BVH is Y-up: its (x, y, z) become (z, x, y). `scale` is metres per unit of the file; by default
    the first of `UNITS_M` that makes the legs, or else the longest limb, those of a person.
    Position channels replace a joint's OFFSET. A root's may also add to it, as some exporters have
    it: whichever brings the lowest joint of the motion nearer to the ground.

    Raises:
        FormatError: The file is cut, malformed, or holds values that are no finite numbers.
    """
    lines = read_lines(path)
    joints, start = read_hierarchy(lines, path.name)
    num_channels = sum(len(joint.channels or ()) for joint in joints)
    num_frames, frame_time, first = read_counts(lines, start, path.name)
    values = read_rows(lines, first, num_frames, num_channels, path.name)
    skeleton = Skeleton(
        name=path.stem,
        joints=tuple(joint.name for joint in joints),
        parents=tuple(joint.parent for joint in joints),
    )
    rotations, translations = _local_transforms(joints, values)
    positions = _positions(rotations, translations, skeleton.parents)
    offset = np.array(joints[0].offset)
    lowest = positions[..., 1].min()
    if abs(lowest + offset[1]) < abs(lowest) and _has_positions(joints[0]):
        positions = positions + offset
    rest = np.median(translations, axis=0)
    rest[0] = 0.0
    scale = guess_scale(rest, skeleton) if scale is None else scale
    return Motion(
        name=path.stem,
        skeleton=skeleton,
        positions=positions[..., [2, 0, 1]] * scale,
        fps=frames_per_second(frame_time),
        rotations=rot.continuous_sign(rotations[..., [0, 3, 1, 2]]),
        rest_offsets=rest[..., [2, 0, 1]] * scale,
    )


def guess_scale(offsets: Float[np.ndarray, "J 3"], skeleton: Skeleton) -> float:
    """Metres per unit of bone vectors: the commonest unit that makes a person of them."""
    lengths = np.linalg.norm(offsets, axis=-1)
    found = resolve_joints(skeleton)
    bones = [found[joint] for joint in ("left_lower_leg", "left_foot") if joint in found]
    leg = float(sum(lengths[skeleton.index(bone)] for bone in bones))
    leg = leg or _reach(lengths, skeleton) * _LEG_PER_REACH
    return plausible_factor(leg, UNITS_M) if leg else UNITS_M[0]


def _reach(lengths: Float[np.ndarray, "J"], skeleton: Skeleton) -> float:
    """Length of the longest chain below the first joint that branches."""
    children = skeleton.children
    reach = np.zeros(len(lengths))
    branched = [len(c) > 1 for c in children]
    for j, parent in enumerate(skeleton.parents):
        if parent >= 0 and branched[parent]:
            branched[j] = True
            reach[j] = reach[parent] + lengths[j]
    return float(reach.max())


def _has_positions(joint: Joint) -> bool:
    return any(kind == "position" for _, kind in joint.channels or ())


def _local_transforms(
    joints: Sequence[Joint], values: Float[np.ndarray, "T C"]
) -> tuple[Float[np.ndarray, "T J 4"], Float[np.ndarray, "T J 3"]]:
    """Rotations and translations of every joint relative to its parent, in the file's axes."""
    rotations = np.empty((len(values), len(joints), 4))
    translations = np.empty((len(values), len(joints), 3))
    column = 0
    for j, joint in enumerate(joints):
        translations[:, j] = joint.offset
        axes, turns = [], []
        for axis, kind in joint.channels or ():
            if kind == "position":
                translations[:, j, "XYZ".index(axis)] = values[:, column]
            else:
                axes.append(axis)
                turns.append(column)
            column += 1
        rotations[:, j] = rot.from_axis_angles(np.radians(values[:, turns]), axes)
    return rotations, translations


def _positions(
    rotations: Float[np.ndarray, "T J 4"],
    translations: Float[np.ndarray, "T J 3"],
    parents: Sequence[int],
) -> Float[np.ndarray, "T J 3"]:
    turned = global_rotations(rotations, parents)
    positions = translations.copy()
    for j, parent in enumerate(parents):
        if parent >= 0:
            bone = rot.rotate(turned[:, parent], translations[:, j])
            positions[:, j] = positions[:, parent] + bone
    return positions


def write_bvh(
    path_or_file: Path | TextIOBase, motion: Motion, *, tolerance_m: float = 8e-5
) -> None:
    """Writes the `rig` of a motion, so that `read_bvh` finds its positions again, to 0.1 mm.

    Joints that move get position channels, and the OFFSET 0: some tools add the two.
    """
    if isinstance(path_or_file, Path):
        with path_or_file.open("w", encoding="utf-8") as file:
            write_bvh(file, motion, tolerance_m=tolerance_m)
        return
    rig = rigged(motion, tolerance_m=tolerance_m)
    columns: list[Float[np.ndarray, "T C"]] = []
    for j in _depth_first(rig):
        if rig.moving[j]:
            columns.append(rig.translations[:, j][:, [1, 2, 0]] * 100.0)
        angles = rot.to_euler(rig.rotations[:, j][:, [0, 2, 3, 1]], _ORDER)
        columns.append(np.degrees(np.unwrap(angles, axis=0)))
    path_or_file.write("HIERARCHY\n")
    path_or_file.writelines(f"{line}\n" for line in _joint_lines(rig, 0, 0))
    path_or_file.write(f"MOTION\nFrames: {motion.num_frames}\n")
    path_or_file.write(f"Frame Time: {1.0 / motion.fps:.9f}\n")
    np.savetxt(path_or_file, np.concatenate(columns, axis=1), fmt="%.6f")


def _depth_first(rig: Rig, joint: int = 0) -> Iterator[int]:
    yield joint
    for child in rig.children[joint]:
        yield from _depth_first(rig, child)


def _joint_lines(rig: Rig, joint: int, depth: int) -> Iterator[str]:
    indent = "  " * depth
    x, y, z = np.where(rig.moving[joint], 0.0, 100.0 * rig.rest[joint, [1, 2, 0]])
    channels = f"6 {_POSITION_CHANNELS}" if rig.moving[joint] else "3"
    yield f"{indent}{'JOINT' if joint else 'ROOT'} {rig.joints[joint]}"
    yield f"{indent}{{"
    yield f"{indent}  OFFSET {x:.6f} {y:.6f} {z:.6f}"
    yield f"{indent}  CHANNELS {channels} {_ROTATION_CHANNELS}"
    children = rig.children[joint]
    for child in children:
        yield from _joint_lines(rig, child, depth + 1)
    if not children:
        tip = f"{_TIP * x:.6f} {_TIP * y:.6f} {_TIP * z:.6f}"
        yield from (f"{indent}  End Site", f"{indent}  {{", f"{indent}    OFFSET {tip}")
        yield f"{indent}  }}"
    yield f"{indent}}}"
