"""The answer to a prediction as JSON bytes, written from arrays without a detour."""

from time import perf_counter
from uuid import uuid4

import numpy as np
import orjson

from models.bundle import Manifest
from service.engine.trajectory import Result
from service.futures import BoneLengths, caller_futures, written
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
    """The body of ``PredictResponse``; futures are rounded to 0.1 mm."""
    started_s = perf_counter()
    caller = observation.caller
    futures = written(
        caller_futures(result.futures, observation, manifest=manifest, bone_lengths=bone_lengths),
        caller,
    )
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
        "num_frames": futures.shape[1],
        "futures": np.ascontiguousarray(futures),
        "steps": {
            "run": result.steps_run,
            "of": result.steps_of,
            "stopped_by": "end" if result.steps_run == result.steps_of else "num_steps",
        },
        "warnings": list(observation.warnings),
        "timing_ms": {name: round(1000.0 * value, 3) for name, value in seconds.items()},
    }
    return orjson.dumps(content, option=orjson.OPT_SERIALIZE_NUMPY)
