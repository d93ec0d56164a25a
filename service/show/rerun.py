"""Futures in Rerun, a viewer of recordings: `pip install 'posefutures[rerun]'`."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun
from jaxtyping import Float

from service.asking.messages import ActionsPrediction, Prediction
from service.show.bones import OBSERVED_RGB, bones, future_rgb, parents_of

RADIUS_M = 0.008


def show(
    answer: Prediction | ActionsPrediction,
    *,
    observed: Float[np.ndarray, "T J 3"] | None = None,
    parents: Sequence[int] | None = None,
    file: Path | None = None,
) -> rerun.RecordingStream:
    """A recording of the observed poses and then of the futures, on the timeline ``motion``.

    Time 0 is now. It goes into a viewer that is opened, or into a ``file`` (.rrd). Positions are
    metres, +Z up.

    Raises:
        ValueError: the skeleton is no standard one, and no ``parents`` are given.
    """
    tree = parents_of(answer.joints, parents)
    recording = rerun.RecordingStream("posefutures")
    if file is None:
        recording.spawn()
    else:
        recording.save(file)
    recording.log("/", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if observed is not None:
        _log(recording, "/observed", bones(observed, tree), OBSERVED_RGB,
             times=np.arange(1 - len(observed), 1) / answer.fps)  # fmt: skip
    for i, future in enumerate(answer.futures):
        _log(recording, f"/futures/{i}", bones(future, tree), future_rgb(i),
             times=np.arange(1, len(future) + 1) / answer.fps)  # fmt: skip
    recording.flush()
    return recording


def _log(
    recording: rerun.RecordingStream,
    path: str,
    frames: Float[np.ndarray, "H B 2 3"],
    colour: tuple[int, int, int],
    *,
    times: Float[np.ndarray, "H"],
) -> None:
    for seconds, lines in zip(times, frames, strict=True):
        recording.set_time("motion", duration=float(seconds))
        recording.log(path, rerun.LineStrips3D(lines, colors=[colour], radii=RADIUS_M))
