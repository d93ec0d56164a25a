"""A request as values: who answers it, what the engine is asked, and what writes its answer."""

import asyncio
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from models.bundle import Manifest
from service import schemas
from service.answers.answer import Answer
from service.answers.occupancy import Query
from service.answers.quantiles import check_levels
from service.catalog import Catalog
from service.engine import trajectory
from service.errors import FieldError, PosesError
from service.futures import num_frames
from service.media import STREAMS
from service.observation import Observation, read_observation
from service.poses.actions import action_indices, max_frames
from service.poses.skeletons import requested_skeleton
from service.settings import Settings
from service.worker import Worker

MANY_FRAMES = 200  # some milliseconds of reading, which the event loop has not got


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Plan:
    """Who answers a request, and what it asks that does not depend on its poses.

    A ``horizon`` of None leaves the number of frames to the bundle.
    """

    manifest: Manifest
    worker: Worker
    horizon: int | None
    most_poses: int
    query: Query | None


def planned(body: schemas.PredictRequest, *, catalog: Catalog, settings: Settings) -> Plan:
    """How a request will be answered.

    Raises:
        ServiceError: it cannot be, whatever its poses are.
    """
    query = _query(body, body.returned)
    manifest, worker = catalog.ready(body.model, with_actions=False)
    horizon = _horizon(body, settings, manifest)
    _check_limits(body, settings)
    if "quantiles" in body.returned:
        check_levels(
            body.quantile_levels, num_samples=body.num_samples, calibration=manifest.calibration
        )
    return Plan(
        manifest=manifest,
        worker=worker,
        horizon=horizon,
        most_poses=settings.max_poses,
        query=query,
    )


async def prepared(
    body: schemas.PredictRequest,
    plan: Plan,
    *,
    request_id: str,
    media_type: str,
    deadline_s: float | None,
    beside: Mapping[str, Any] | None = None,
) -> tuple[trajectory.Request, Answer]:
    """What the engine is asked, and what writes its answer.

    Raises:
        FieldError: the poses, or the skeleton that they are in, are not those of a person.
    """
    manifest, horizon = plan.manifest, plan.horizon
    frames = horizon or manifest.horizon
    observation = await _observation(body, manifest)
    _check_answer(body, plan.most_poses, manifest, frames=frames, fps=observation.caller.fps)
    request = trajectory.Request(
        observation=observation.positions,
        num_samples=body.num_samples,
        num_steps=body.num_steps,
        seed=seed_of(body),
        deadline_s=deadline_s,
        tolerance_m=body.tolerance_m,
        horizon=horizon,
        previews=media_type in STREAMS,
    )
    answer = Answer(
        id=request_id,
        media_type=media_type,
        observation=observation,
        manifest=manifest,
        seed=request.seed,
        bone_lengths=body.bone_lengths,
        warnings=_rolled_out(frames, manifest),
        returned=body.returned,
        num_modes=body.num_modes,
        levels=body.quantile_levels,
        query=plan.query,
        beside=beside or {},
    )
    return request, answer


async def prepared_actions(
    body: schemas.PredictActionsRequest,
    *,
    catalog: Catalog,
    settings: Settings,
    request_id: str,
    media_type: str,
    deadline_s: float | None,
) -> tuple[Worker, trajectory.Request, Answer]:
    """Who performs actions, what it is asked, and what writes its answer.

    Raises:
        ServiceError: it cannot be answered.
    """
    query = _query(body, body.returned)
    manifest, worker = catalog.ready(body.model, with_actions=True)
    indices = action_indices(body.actions, manifest)
    longest = max_frames(body.max_seconds_per_action, manifest)
    _check_limits(body, settings)
    observation = await _observation(body, manifest)
    most = len(indices) * (longest or manifest.horizon)
    _check_answer(body, settings.max_poses, manifest, frames=most, fps=observation.caller.fps)
    request = trajectory.Request(
        observation=observation.positions,
        num_samples=body.num_samples,
        seed=seed_of(body),
        actions=indices,
        stop_threshold_m=body.stop_threshold,
        max_frames=longest,
        deadline_s=deadline_s,
        previews=media_type in STREAMS,
    )
    answer = Answer(
        id=request_id,
        media_type=media_type,
        observation=observation,
        manifest=manifest,
        seed=request.seed,
        bone_lengths=body.bone_lengths,
        warnings=(),
        returned=body.returned,
        query=query,
    )
    return worker, request, answer


def seed_of(body: schemas.ObservedMotion) -> int:
    """The seed of a request; drawn where it has none."""
    return secrets.randbelow(schemas.MAX_SEED + 1) if body.seed is None else body.seed


async def _observation(body: schemas.ObservedMotion, manifest: Manifest) -> Observation:
    def read() -> Observation:
        return read_observation(
            body.poses,
            skeleton=requested_skeleton(body.caller_skeleton(), manifest),
            axes=body.axes.axes(),
            fps=body.fps,
            manifest=manifest,
            times=body.timestamps,
            confidence=body.confidence,
        )

    return await asyncio.to_thread(read) if len(body.poses) > MANY_FRAMES else read()


def deadline_of(
    body: schemas.ObservedMotion, *, arrived_s: float, timeout_s: float | None = None
) -> float | None:
    """The sooner of both deadlines, on the clock of ``perf_counter``, counted from the arrival."""
    seconds = [timeout_s] if timeout_s is not None else []
    if body.deadline_ms is not None:
        seconds.append(body.deadline_ms / 1000.0)
    return arrived_s + min(seconds) if seconds else None


def _horizon(body: schemas.PredictRequest, settings: Settings, manifest: Manifest) -> int | None:
    if body.horizon_s is None:
        return None
    if body.horizon_s > settings.max_horizon_s:
        raise FieldError(
            pointer="/horizon_s",
            found=f"{body.horizon_s:g} s",
            expected=f"this server predicts at most {settings.max_horizon_s:g} s",
        )
    return max(1, round(body.horizon_s * manifest.fps))


def _rolled_out(frames: int, manifest: Manifest) -> list[str]:
    if frames <= manifest.horizon:
        return []
    learnt_s, asked_s = manifest.horizon / manifest.fps, frames / manifest.fps
    return [
        f"horizon_s: {manifest.name} was made for {learnt_s:g} s; from there to {asked_s:g} s its "
        "own last frames were continued, and are less certain the later they are."
    ]


def _query(body: schemas.ObservedMotion, returned: Sequence[str]) -> Query | None:
    """What is asked of regions, in metres, +Z up."""
    if body.occupancy is None:
        if "occupancy" not in returned:
            return None
        raise FieldError(
            pointer="/occupancy",
            found="nothing",
            expected="its regions are required where return names occupancy",
        )
    if "occupancy" not in returned:
        raise FieldError(
            pointer="/return",
            found=", ".join(returned),
            expected="it must name occupancy where regions are given",
        )
    return body.occupancy.query(body.axes.axes())


def _check_limits(body: schemas.ObservedMotion, settings: Settings) -> None:
    if body.num_samples > settings.max_samples:
        raise FieldError(
            pointer="/num_samples",
            found=str(body.num_samples),
            expected=f"this server gives at most {settings.max_samples}",
        )
    if len(body.poses) > settings.max_frames:
        raise PosesError(
            pointer="/poses",
            found=f"{len(body.poses)} frames",
            expected=f"this server takes at most {settings.max_frames}; send the last ones",
        )


def _check_answer(
    body: schemas.ObservedMotion, most_poses: int, manifest: Manifest, *, frames: int, fps: float
) -> None:
    """The engine holds ``frames`` a future, at the bundle's rate; the answer, at the caller's."""
    longest = max(frames, num_frames(frames, manifest=manifest, fps=fps))
    if body.num_samples * longest > most_poses:
        raise FieldError(
            pointer="/num_samples",
            found=f"{body.num_samples} futures of up to {longest} frames",
            expected=f"this server answers with at most {most_poses} poses; ask for fewer "
            "samples or actions, or for less time or a lower rate",
        )
