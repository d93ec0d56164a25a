"""The answer to a prediction as JSON bytes, written from arrays without a detour."""

from collections.abc import Sequence
from time import perf_counter
from typing import Any
from uuid import uuid4

import numpy as np
import orjson
from jaxtyping import Float

from models.bundle import Manifest
from service.engine.trajectory import Result, Segment
from service.futures import BoneLengths, caller_futures, caller_segments, written
from service.observation import Observation
from service.worker import Timing


def json_answer(
    result: Result,
    timing: Timing,
    *,
    observation: Observation,
    manifest: Manifest,
    seed: int,
    bone_lengths: BoneLengths,
) -> bytes:
    """The body of ``PredictResponse``, or of ``PredictActionsResponse`` for a bundle with actions.

    Futures are rounded to 0.1 mm.
    """
    started_s = perf_counter()
    caller = observation.caller
    in_world = caller_futures(
        result.futures,
        observation,
        manifest=manifest,
        bone_lengths=bone_lengths,
        segments=result.segments,
    )
    futures = np.ascontiguousarray(written(in_world, caller))
    if manifest.actions is None:
        answer = _continued(futures, result)
    else:
        segments = caller_segments(result.segments, manifest=manifest, fps=caller.fps)
        answer = _performed(futures, segments, labels=manifest.actions.labels)
    names = dict(zip(caller.order, caller.skeleton.joints, strict=True))
    seconds = {
        "queue": timing.queue_s,
        "engine": timing.engine_s,
        "answer": perf_counter() - started_s,
    }
    content = {
        "id": str(uuid4()),
        "model": {
            "name": manifest.name,
            "version": manifest.version,
            "digest": manifest.digest,
        },
        "seed": seed,
        "fps": caller.fps,
        "skeleton": caller.skeleton.name,
        "joints": [names[i] for i in range(len(names))],
        **answer,
        "warnings": list(observation.warnings),
        "timing_ms": {name: round(1000.0 * value, 3) for name, value in seconds.items()},
    }
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)


def _continued(futures: Float[np.ndarray, "N H J 3"], result: Result) -> dict[str, Any]:
    return {
        "num_frames": futures.shape[1],
        "futures": futures,
        "steps": {
            "run": result.steps_run,
            "of": result.steps_of,
            "stopped_by": "end" if result.steps_run == result.steps_of else "num_steps",
        },
    }


def _performed(
    futures: Float[np.ndarray, "N H J 3"],
    segments: Sequence[Sequence[Segment]],
    *,
    labels: Sequence[str],
) -> dict[str, Any]:
    """Each future as long as its actions took, and the frames of each action in it."""
    return {
        "futures": [
            {
                "num_frames": parts[-1].end,
                "poses": future[: parts[-1].end],
                "segments": [
                    {
                        "action": labels[part.action],
                        "start": part.start,
                        "end": part.end,
                        "stopped": part.stopped,
                    }
                    for part in parts
                ],
            }
            for future, parts in zip(futures, segments, strict=True)
        ]
    }
