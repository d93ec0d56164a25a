"""Small stores, archives and BVH files of people who walk."""

from pathlib import Path

import numpy as np
from tiny_bundles import standing_pose, walking

from models.motion.formats.bvh import write_bvh
from models.motion.formats.npz import clip_of, write_archive
from models.motion.kinematics import bone_lengths, fit_bone_lengths, rotate_yaw
from models.motion.motion import Motion
from models.motion.skeleton import BODY21
from training.data.store import ClipRecord, Recording, Store, open_store, write_store


def walker(num_frames: int, *, seed: int = 0, fps: float = 30.0, name: str = "walker") -> Motion:
    """A person who walks with a gait, a heading, and swinging feet and hands of their own."""
    generator = np.random.default_rng(seed)
    poses = walking(num_frames, fps=fps, speed=float(generator.uniform(0.6, 1.6)))
    times = np.arange(num_frames) / fps
    for joint in ("left_foot", "right_foot", "left_hand", "right_hand"):
        rate, phase = generator.uniform(0.5, 1.5), generator.uniform(0, 6)
        swing = 0.15 * np.sin(2 * np.pi * rate * times + phase)
        poses[:, BODY21.index(joint), 0] += swing + 0.1 * np.sin(np.pi * rate * times)
    lengths = bone_lengths(standing_pose(), BODY21.parents)
    rigid = fit_bone_lengths(poses, lengths, BODY21.parents)
    turned = rotate_yaw(rigid, float(generator.uniform(-3, 3)))
    return Motion(name=name, skeleton=BODY21, positions=turned, fps=fps)


def write_walkers(folder: Path, names: dict[str, int], *, fps: float = 60.0) -> Path:
    """A folder of BVH files, each with the seed of its walker, two seconds long."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, seed in names.items():
        write_bvh(folder / f"{name}.bvh", walker(round(2 * fps), seed=seed, fps=fps, name=name))
    return folder


def write_small_archive(path: Path, *, num_clips: int = 4, num_frames: int = 90) -> Path:
    clips = [
        clip_of(walker(num_frames, seed=i, name=f"take{i}"), action=f"action{i % 2}", subject="07")
        for i in range(num_clips)
    ]
    write_archive(path, clips)
    return path


def small_store(folder: Path, *, num_clips: int = 6, num_frames: int = 120) -> Store:
    """Walkers of two styles and sources; the last is the only one of the split ``valid``."""
    clips = []
    for i in range(num_clips):
        motion = walker(num_frames + 7 * i, seed=i)
        record = ClipRecord(
            name=f"take{i}",
            source=f"{'left' if i % 2 else 'right'}-{i}",
            split="valid" if i == num_clips - 1 else "train",
            start=0,
            length=motion.num_frames,
            action=f"action{i % 3}",
            style="old" if i == 0 else "young",
            subject=str(i),
        )
        recording = Recording(
            positions=motion.positions.astype(np.float32), rest_offsets=np.zeros((21, 3))
        )
        clips.append((record, recording))
    write_store(folder, skeleton=BODY21, fps=30.0, clips=clips, files={})
    return open_store(folder)
