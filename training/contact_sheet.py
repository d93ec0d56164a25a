"""Stick figures of a bundle's futures, to look at: one PNG."""

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from PIL import Image

from models.bundle import read_manifest
from models.motion.kinematics import rotate_yaw, yaw
from models.motion.skeleton import Skeleton
from service.engine.engine import Engine
from service.engine.runner import Runner
from service.engine.trajectory import Request
from training.data.store import ClipRecord, Store
from training.data.windows import Windows, cut
from training.predictors import BundlePredictor

NUM_WINDOWS, NUM_SAMPLES, NUM_TIMES = 10, 3, 5
SAMPLES = tuple(f"sample {i}" for i in range(NUM_SAMPLES))
PALETTE = 32
STILL_M, SPREAD_M = 0.5, 0.7  # who moves less is drawn once more at every time, so far apart
NEAR, FAR = "tab:blue", "tab:orange"  # the left and the right side of the body


def contact_sheet(
    bundle: Path, store: Store, clips: Sequence[ClipRecord], out: Path, *, seed: int = 0
) -> None:
    """Draw ten windows: the true future and three sampled ones, at five times each.

    All are seen from the side, along the horizontal line across which the true body moves most.

    Raises:
        StoreError: none of the clips is long enough.
        BundleError: the bundle cannot be used.
    """
    manifest = read_manifest(bundle)
    num_observed, num_frames = manifest.num_observed, manifest.num_observed + manifest.horizon
    windows = Windows.of(tuple(clips), num_frames=num_frames, stride=num_observed)
    chosen = _spread(windows, [clip.action or clip.name for clip in clips])
    poses = cut(store, windows, num_frames=num_frames, indices=chosen)
    predict = BundlePredictor(
        engine=Engine(Runner(manifest, bundle, threads=1)),
        num_samples=NUM_SAMPLES,
        num_steps=None,
        seed=seed,
    )
    times = np.linspace(0, manifest.horizon, NUM_TIMES + 1).round().astype(int)[1:] - 1
    figure = Figure(figsize=(16, 1.7 * len(chosen)), layout="constrained")
    grid = figure.subplots(len(chosen), 1 + NUM_SAMPLES, squeeze=False)
    answers = predict(poses[:, :num_observed], ("observed",))
    for row, window, index, answer in zip(grid, poses, chosen, answers, strict=True):
        clip = clips[windows.clip_index[index]]
        futures = np.concatenate([window[None, num_observed:], answer["observed"]])
        side = _from_the_side(window[num_observed - 1], futures, times, store.skeleton)
        _draw_row(row, side, store.skeleton)
        row[0].set_ylabel(f"{clip.action or clip.name}\n{clip.style or clip.subject}", fontsize=8)
    _save(figure, grid[0], ["true", *SAMPLES], out)


def action_sheet(
    bundle: Path, store: Store, clips: Sequence[ClipRecord], out: Path, *, seed: int = 0
) -> None:
    """Draw three sampled futures of every action after the beginning of the first clip.

    Each is shown at five times, evenly spread over its own length, which stands below it.

    Raises:
        StoreError: none of the clips is long enough.
        BundleError: the bundle cannot be used.
    """
    manifest = read_manifest(bundle)
    labels = manifest.actions.labels if manifest.actions else ()
    windows = Windows.of(tuple(clips), num_frames=manifest.num_observed)
    (observation,) = cut(
        store, windows, num_frames=manifest.num_observed, indices=np.zeros(1, np.int64)
    )
    requests = [
        Request(observation=observation, num_samples=NUM_SAMPLES, seed=seed, actions=(action,))
        for action in range(len(labels))
    ]
    engine = Engine(Runner(manifest, bundle, threads=1))
    figure = Figure(figsize=(16, 1.7 * len(labels)), layout="constrained")
    grid = figure.subplots(len(labels), NUM_SAMPLES, squeeze=False)
    for row, label, result in zip(grid, labels, engine.run(requests), strict=True):
        ends = [segment.end for (segment,) in result.segments]
        shown = [
            future[np.linspace(0, end, NUM_TIMES + 1).round().astype(int)[1:] - 1]
            for future, end in zip(result.futures, ends, strict=True)
        ]
        side = _from_the_side(
            observation[-1], np.stack(shown), np.arange(NUM_TIMES), store.skeleton
        )
        _draw_row(row, side, store.skeleton)
        row[0].set_ylabel(label, fontsize=8)
        for axes, end in zip(row, ends, strict=True):
            axes.set_xlabel(f"{end / manifest.fps:.1f} s", fontsize=8)
    _save(figure, grid[0], SAMPLES, out)


def _draw_row(row: np.ndarray, side: Float[np.ndarray, "N poses J 2"], skeleton: Skeleton) -> None:
    for axes, path in zip(row, side, strict=True):
        _draw(axes, path, skeleton)
        axes.set_xlim(side[..., 0].min() - 0.2, side[..., 0].max() + 0.2)
        axes.set_ylim(side[..., 1].min() - 0.1, side[..., 1].max() + 0.1)


def _save(figure: Figure, first_row: np.ndarray, titles: Sequence[str], out: Path) -> None:
    for axes, title in zip(first_row, titles, strict=True):
        axes.set_title(title, fontsize=9)
    save_small(figure, out)


def save_small(figure: Figure, out: Path) -> None:
    """Write a figure as a PNG that is small enough to be committed: of a few colours."""
    out.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    buffer = BytesIO()
    figure.savefig(buffer, dpi=72)
    Image.open(buffer).convert("RGB").quantize(PALETTE).save(out, optimize=True)


def _spread(windows: Windows, actions: Sequence[str]) -> Int[np.ndarray, "W"]:
    """Windows from the middle of clips of as many different actions as there are."""
    ends = [np.flatnonzero(windows.clip_index == clip) for clip in np.unique(windows.clip_index)]
    middles = np.array([mine[len(mine) // 2] for mine in ends])
    seen: dict[str, int] = {}
    turns: list[int] = []
    for middle in middles:  # the first clip of every action, then the second of every action, …
        action = actions[int(windows.clip_index[middle])]
        turns.append(seen.get(action, 0))
        seen[action] = turns[-1] + 1
    first = middles[np.array(turns) == 0]
    if len(first) >= NUM_WINDOWS:
        return np.asarray(first[np.linspace(0, len(first) - 1, NUM_WINDOWS).round().astype(int)])
    return np.sort(middles[np.argsort(np.array(turns), kind="stable")[:NUM_WINDOWS]])


def _from_the_side(
    now: Float[np.ndarray, "J 3"],
    futures: Float[np.ndarray, "N H J 3"],
    times: Int[np.ndarray, "K"],
    skeleton: Skeleton,
) -> Float[np.ndarray, "N poses J 2"]:
    """The last observed pose and the future ones at some times, as (along, up) in metres."""
    start = np.broadcast_to(now, (len(futures), 1, *now.shape))
    poses = np.concatenate([start, futures[:, times]], axis=1) - now[0] * np.array([1, 1, 0])
    gone = poses[0, -1, 0]
    still = float(np.hypot(gone[0], gone[1])) < STILL_M
    heading = yaw(now, skeleton) if still else np.arctan2(gone[1], gone[0])
    side = rotate_yaw(poses, -np.asarray(heading))[..., [0, 2]]
    if still:
        side[..., 0] += SPREAD_M * np.arange(side.shape[1])[:, None]
    return np.asarray(side)


def _draw(axes: Axes, poses: Float[np.ndarray, "poses J 2"], skeleton: Skeleton) -> None:
    colours = {"left": NEAR, "right": FAR, "center": "black"}
    bones = [(joint, parent) for joint, parent in enumerate(skeleton.parents) if parent >= 0]
    for index, pose in enumerate(poses):
        strength = 0.35 + 0.65 * index / (len(poses) - 1)
        tints = [
            to_rgba("grey" if index == 0 else colours[skeleton.sides[joint]], strength)
            for joint, _ in bones
        ]
        axes.add_collection(
            LineCollection([pose[list(bone)] for bone in bones], colors=tints, linewidths=1.1)
        )
    axes.axhline(poses[0, :, 1].min(), color="lightgrey", linewidth=0.6, zorder=0)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=6)
