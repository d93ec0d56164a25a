"""The answer to a prediction as bytes, written from arrays without a detour."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from time import perf_counter
from typing import Any

import numpy as np
from jaxtyping import Float

from models.bundle import Manifest
from models.motion.axes import UNITS_PER_METRE
from service.answers.downloads import download
from service.answers.modes import modes
from service.answers.occupancy import Query
from service.answers.quantiles import regions
from service.engine.trajectory import Preview, Result, Segment
from service.futures import DECIMALS, BoneLengths, caller_futures, caller_segments, written
from service.media import MOTIONS, encoded
from service.observation import Observation
from service.worker import Timing

_IN_FILES = ("futures", "quantiles")


@dataclass(kw_only=True, slots=True, eq=False)
class Answer:
    """Writes the answers to one request, in the worker's thread; then there are ``stages_s``.

    Numbers are rounded to 0.1 mm. Equal requests of equal ids have equal bytes up to ``timing_ms``,
    which comes last. Where something goes ``beside`` it, the answer is under ``answer``.
    """

    id: str
    media_type: str
    observation: Observation
    manifest: Manifest
    seed: int
    bone_lengths: BoneLengths
    warnings: Sequence[str]
    returned: Sequence[str] = ("futures",)
    num_modes: int = 1
    levels: Sequence[float] = ()
    query: Query | None = None
    beside: Mapping[str, Any] = field(default_factory=dict)
    stages_s: dict[str, float] = field(default_factory=dict)
    facts: dict[str, Any] = field(default_factory=dict)
    motions: Sequence[Float[np.ndarray, "_ J 3"]] = ()
    about: dict[str, Any] = field(default_factory=dict)

    def final(self, result: Result, timing: Timing) -> bytes:
        """The body of ``PredictResponse``, or of ``PredictActionsResponse`` for actions.

        It is empty where ``files`` are to be written.
        """
        started_s = perf_counter()
        caller = self.observation.caller
        in_world = self._in_world(result.futures, result.segments)
        segments = self._caller_segments(result.segments)
        part = (
            self._performed(in_world, segments)
            if self._performs
            else self._continued(in_world, result)
        )
        names = dict(zip(caller.order, caller.skeleton.joints, strict=True))
        sources = dict(zip(caller.order, caller.sources, strict=True))
        content = self.head() | {
            "fps": caller.fps,
            "skeleton": caller.skeleton.name,
            "joints": [names[i] for i in range(len(names))],
            "joint_sources": [sources[i] for i in range(len(names))],
            **part,
            "warnings": [*self.observation.warnings, *self.warnings],
        }
        self.stages_s |= {
            "queue": timing.queue_s,
            "engine": timing.engine_s,
            "answer": perf_counter() - started_s,
        }
        content["timing_ms"] = self.milliseconds()
        if self.media_type in MOTIONS:
            ends = [parts[-1].end for parts in segments] or [in_world.shape[1]] * len(in_world)
            self.motions = [path[:end] for path, end in zip(in_world, ends, strict=True)]
            self.about = {key: told for key, told in content.items() if key not in _IN_FILES}
            body = b""
        else:
            message = {**self.beside, "answer": content} if self.beside else content
            body = encoded(message, self.media_type)
        self.stages_s["answer"] = perf_counter() - started_s
        self.facts |= {
            "steps_run": result.steps_run,
            "steps_of": result.steps_of,
            "stopped_by": result.stopped_by,
        }
        return body

    def files(self) -> tuple[bytes, dict[str, str]]:
        """The futures of a final answer as files, and their headers; it takes a while."""
        caller = self.observation.caller
        return download(self.motions, caller, self.media_type, about=self.about)

    def milliseconds(self) -> dict[str, float]:
        """How long each stage took; that of the answer, so far."""
        return {name: round(1000.0 * seconds, 3) for name, seconds in self.stages_s.items()}

    def preview(self, preview: Preview) -> bytes:
        """Futures as they stand after a step."""
        in_world = self._in_world(preview.futures, preview.segments)
        futures = (
            self._lasting(in_world, self._caller_segments(preview.segments))
            if self._performs
            else written(in_world, self.observation.caller)
        )
        steps = {"run": preview.steps_run, "of": preview.steps_of}
        content = {"id": self.id, "steps": steps, "futures": futures}
        return encoded(content, self.media_type)

    def head(self) -> dict[str, Any]:
        """Which request and bundle it is about."""
        model = self.manifest
        return {
            "id": self.id,
            "model": {"name": model.name, "version": model.version, "digest": model.digest},
            "seed": self.seed,
        }

    def _in_world(
        self,
        futures: Float[np.ndarray, "N H Jb 3"],
        segments: Sequence[Sequence[Segment]] = (),
    ) -> Float[np.ndarray, "N Hc J 3"]:
        return caller_futures(
            futures,
            self.observation,
            manifest=self.manifest,
            bone_lengths=self.bone_lengths,
            segments=segments,
        )

    @property
    def _performs(self) -> bool:
        return self.manifest.actions is not None

    def _caller_segments(self, segments: Sequence[Sequence[Segment]]) -> list[list[Segment]]:
        return caller_segments(segments, manifest=self.manifest, fps=self.observation.caller.fps)

    def _continued(self, in_world: Float[np.ndarray, "N H J 3"], result: Result) -> dict[str, Any]:
        content: dict[str, Any] = {"num_frames": in_world.shape[1]}
        if "futures" in self.returned:
            content["futures"] = written(in_world, self.observation.caller)
        if "modes" in self.returned:
            content["modes"] = [
                {
                    "probability": mode.probability,
                    "sample": mode.sample,
                    "members": list(mode.members),
                }
                for mode in modes(in_world, num_modes=self.num_modes)
            ]
        if "quantiles" in self.returned:
            content["quantiles"] = self._quantiles(in_world)
        content |= self._occupancy(list(in_world))
        steps = {"run": result.steps_run, "of": result.steps_of, "stopped_by": result.stopped_by}
        return content | {"steps": steps}

    def _quantiles(self, in_world: Float[np.ndarray, "N H J 3"]) -> dict[str, Any]:
        """Balls in the caller's order, axes and units."""
        caller = self.observation.caller
        found = regions(
            in_world, fps=caller.fps, calibration=self.manifest.calibration, levels=self.levels
        )
        units = UNITS_PER_METRE[caller.axes.units]
        radius = np.empty_like(found.radius)
        radius[:, :, list(caller.order)] = found.radius
        decimals = DECIMALS - round(np.log10(units))
        return {
            "levels": list(found.levels),
            "centre": written(found.centre[None], caller)[0],
            "radius": np.round(radius * units, decimals).astype(np.float32),
            "calibrated": found.calibrated,
        }

    def _occupancy(self, in_world: Sequence[Float[np.ndarray, "_ J 3"]]) -> dict[str, Any]:
        if self.query is None:
            return {}
        caller = self.observation.caller
        units = UNITS_PER_METRE[caller.axes.units]
        decimals = DECIMALS - round(np.log10(units))
        return {
            "occupancy": [
                {
                    "probability": found.probability.astype(np.float32),
                    "num_lasting": found.num_lasting.tolist(),
                    "first_entry": {
                        "never": found.never,
                        "levels": list(found.levels),
                        "time_s": [
                            round(t, 4) if t < inf else None for t in found.first_entry_s.tolist()
                        ],
                    },
                    "min_distance": {
                        "levels": list(found.levels),
                        "distance": np.round(found.min_distance * units, decimals).tolist(),
                    },
                }
                for found in self.query.of(in_world, caller)
            ]
        }

    def _performed(
        self, in_world: Float[np.ndarray, "N H J 3"], segments: Sequence[Sequence[Segment]]
    ) -> dict[str, Any]:
        """Each future as long as its actions took, and what of them was asked for beside."""
        content: dict[str, Any] = {}
        if "futures" in self.returned:
            content["futures"] = self._lasting(in_world, segments)
        ends = [parts[-1].end for parts in segments]
        lasting = [future[:end] for future, end in zip(in_world, ends, strict=True)]
        return content | self._occupancy(lasting)

    def _lasting(
        self, in_world: Float[np.ndarray, "N H J 3"], segments: Sequence[Sequence[Segment]]
    ) -> list[dict[str, Any]]:
        """Each future as long as its actions took, and the frames of each action in it."""
        labels = self.manifest.actions.labels if self.manifest.actions else ()
        futures = written(in_world, self.observation.caller)
        return [
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
