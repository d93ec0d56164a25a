"""The paths that predict: a request becomes values, and its futures a response or a stream."""

import asyncio
import secrets
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Header, Request, Response

from models.bundle import Manifest
from service import schemas
from service.actions import action_indices, max_frames
from service.answer import Answer
from service.body import BodyRoute
from service.catalog import Catalog
from service.delivery import Stream, event, unless_gone
from service.dependencies import TheCatalog, TheSettings, metrics_of, settings_of, visit_of
from service.engine import trajectory
from service.errors import (
    BodyTooLargeError,
    CancelledRequestError,
    DeadlineError,
    EngineError,
    FieldError,
    MalformedBodyError,
    MediaTypeError,
    NotAcceptableError,
    OverloadedError,
    PosesError,
    RateLimitedError,
    UnauthorisedError,
    UnavailableError,
    UnknownRequestError,
)
from service.futures import num_frames
from service.media import BVH, DOCUMENTS, GLB, MOTIONS, MSGPACK, NPZ, STREAMS, ZIP, accepted
from service.observation import Observation, read_observation
from service.occupancy import Query
from service.problems import declared
from service.quantiles import check_levels
from service.settings import Settings
from service.skeletons import requested_skeleton
from service.telemetry import record_stages
from service.visits import CLIENT_GONE
from service.worker import Timing, Worker

MANY_FRAMES = 200  # some milliseconds of reading, which the event loop has not got

router = APIRouter(route_class=BodyRoute, responses=declared(UnauthorisedError))

_TimeoutHeader = Annotated[
    float | None,
    Header(
        alias="X-Request-Timeout-Seconds",
        gt=0,
        allow_inf_nan=False,
        description="as deadline_ms; the smaller one counts",
    ),
]

_PROBLEMS = declared(
    MalformedBodyError,
    NotAcceptableError,
    CancelledRequestError,
    BodyTooLargeError,
    MediaTypeError,
    FieldError,
    RateLimitedError,
    OverloadedError,
    EngineError,
    UnavailableError,
    DeadlineError,
)


def _described(description: str) -> dict[str, Any]:
    return {"schema": {"type": "string", "format": "binary", "description": description}}


_BINARY = {
    MSGPACK: _described(
        'as the JSON, with {"shape": [...], "dtype": "float32", "data": little-endian bytes} in '
        "the place of each array; a joint of three NaN was not seen"
    ),
    NPZ: _described(
        "arrays by their path, such as poses or futures/0/poses, beside `meta`, which is the rest "
        "as JSON"
    ),
}
_FILES = {
    BVH: _described("the future as a BVH file, Y-up, centimetres, where num_samples is 1"),
    GLB: _described("the future as an animated glTF file where num_samples is 1"),
    ZIP: _described("where a file was accepted and num_samples is more: one for each future"),
}
_EVENTS = _described(
    "accepted {id, model, seed, steps.of}, preview {id, steps, futures} after each step, or each "
    "chunk of frames of actions, final (the plain JSON), end; or an error instead of what is left; "
    "a stream without end is not complete"
)
_BODIES = {"requestBody": {"content": _BINARY}}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"content": _BINARY | _FILES | dict.fromkeys(STREAMS, _EVENTS)}
}


@router.post(
    "/v1/predict",
    operation_id="predict_v1",
    response_model=schemas.PredictResponse,
    responses=_PROBLEMS | _ANSWERS,
    openapi_extra=_BODIES,
)
@router.post(
    "/predict",
    operation_id="predict",
    response_model=schemas.PredictResponse,
    responses=_PROBLEMS | _ANSWERS,
    openapi_extra=_BODIES,
)
async def predict(
    body: schemas.PredictRequest,
    http: Request,
    catalog: TheCatalog,
    settings: TheSettings,
    timeout_s: _TimeoutHeader = None,
) -> Response:
    """N futures of the person in the poses, in the caller's world, skeleton and frame rate."""
    media_type = accepted(http.headers.get("accept", ""), (*DOCUMENTS, *STREAMS, *MOTIONS))
    _check_returned(body.returned, media_type)
    plan, visit = planned(body, catalog=catalog, settings=settings), visit_of(http)
    request, answer = await prepared(
        body,
        plan,
        request_id=visit.request_id,
        media_type=media_type,
        deadline_s=deadline_of(body, arrived_s=visit.arrived_s, timeout_s=timeout_s),
    )
    return await _answered(http, plan.worker, request, answer)


@router.post(
    "/v1/predict_actions",
    operation_id="predict_actions_v1",
    response_model=schemas.PredictActionsResponse,
    responses=_PROBLEMS | _ANSWERS,
    openapi_extra=_BODIES,
)
@router.post(
    "/predict_actions",
    operation_id="predict_actions",
    response_model=schemas.PredictActionsResponse,
    responses=_PROBLEMS | _ANSWERS,
    openapi_extra=_BODIES,
)
async def predict_actions(
    body: schemas.PredictActionsRequest,
    http: Request,
    catalog: TheCatalog,
    settings: TheSettings,
    timeout_s: _TimeoutHeader = None,
) -> Response:
    """N futures of the person in the poses, who performs the actions one after the other."""
    media_type = accepted(http.headers.get("accept", ""), (*DOCUMENTS, *STREAMS, *MOTIONS))
    _check_returned(body.returned, media_type)
    _query(body, body.returned)
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
        deadline_s=deadline_of(body, arrived_s=visit_of(http).arrived_s, timeout_s=timeout_s),
        previews=media_type in STREAMS,
    )
    answer = Answer(
        id=visit_of(http).request_id,
        media_type=media_type,
        observation=observation,
        manifest=manifest,
        seed=request.seed,
        bone_lengths=body.bone_lengths,
        warnings=(),
        returned=body.returned,
        query=_query(body, body.returned),
    )
    return await _answered(http, worker, request, answer)


@router.delete(
    "/v1/requests/{request_id}",
    operation_id="cancel_v1",
    status_code=204,
    responses=declared(UnknownRequestError),
)
@router.delete(
    "/requests/{request_id}",
    operation_id="cancel",
    status_code=204,
    responses=declared(UnknownRequestError),
)
async def cancel(request_id: str, catalog: TheCatalog) -> None:
    """Free the rows of the prediction with this X-Request-Id; whoever waits for it gets 409."""
    workers = [entry.worker for entry in catalog.entries.values() if entry.worker is not None]
    if not any([worker.cancel(request_id) for worker in workers]):
        raise UnknownRequestError(
            f"request_id: found {request_id[:64]!r}; nothing of this id is under way.",
            found=repr(request_id[:64]),
            expected="the X-Request-Id of a prediction that is under way",
        )


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Plan:
    """Who answers a request, with how many frames (None leaves that to the bundle) and poses."""

    manifest: Manifest
    worker: Worker
    horizon: int | None
    most_poses: int


def planned(body: schemas.PredictRequest, *, catalog: Catalog, settings: Settings) -> Plan:
    """How a request will be answered.

    Raises:
        ServiceError: it cannot be, whatever its poses are.
    """
    _query(body, body.returned)
    manifest, worker = catalog.ready(body.model, with_actions=False)
    horizon = _horizon(body, settings, manifest)
    _check_limits(body, settings)
    if "quantiles" in body.returned:
        check_levels(
            body.quantile_levels, num_samples=body.num_samples, calibration=manifest.calibration
        )
    return Plan(manifest=manifest, worker=worker, horizon=horizon, most_poses=settings.max_poses)


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
        query=_query(body, body.returned),
        beside=beside or {},
    )
    return request, answer


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


async def _answered(
    http: Request, worker: Worker, request: trajectory.Request, answer: Answer
) -> Response:
    if http.app.state.draining:
        raise UnavailableError("the server is stopping; ask another one, or again in a second.")
    visit = visit_of(http)
    visit.facts |= {"model": answer.manifest.name, "digest": answer.manifest.digest,
                    "seed": request.seed, "rows": request.num_samples}  # fmt: skip

    def ended() -> None:
        if not answer.stages_s:  # a stream that nobody read to its end, or that failed
            visit.status = CLIENT_GONE if visit.status == 200 else visit.status
            return
        record_stages(answer.stages_s)
        visit.facts |= answer.facts | {
            f"{name}_ms": ms for name, ms in answer.milliseconds().items()
        }
        deadline_s = request.deadline_s
        metrics_of(http).answered(
            model=answer.manifest.name,
            media_type=answer.media_type,
            encode_s=answer.stages_s["answer"],
            slack_s=None if deadline_s is None else deadline_s - perf_counter(),
        )

    if answer.media_type in STREAMS:
        return await _streamed(http, worker, request, answer, ended)
    work = worker.predict(request, answer.final, request_key=answer.id)
    content = await unless_gone(http, work)
    ended()
    headers = {"Content-Type": answer.media_type}
    if answer.media_type in MOTIONS:
        content, headers = await asyncio.to_thread(answer.files)
    timing = ", ".join(f"{name};dur={ms}" for name, ms in answer.milliseconds().items())
    return Response(content, headers=headers | {"Server-Timing": timing})


async def _streamed(
    http: Request,
    worker: Worker,
    request: trajectory.Request,
    answer: Answer,
    ended: Callable[[], None],
) -> Response:
    streams: set[Answer] = http.app.state.streams
    most = settings_of(http).max_streams
    if len(streams) >= most:
        raise OverloadedError(
            f"the server: found {len(streams)} open streams; it has at most {most}.",
            retry_after_s=1.0,
        )
    media_type, visit = answer.media_type, visit_of(http)

    def preview(found: trajectory.Preview) -> bytes:
        if "first_preview_ms" not in visit.facts:
            seconds = perf_counter() - visit.arrived_s
            visit.facts["first_preview_ms"] = round(1000.0 * seconds, 3)
            metrics_of(http).previewed(model=answer.manifest.name, seconds=seconds)
        return event("preview", answer.preview(found), media_type)

    def final(result: trajectory.Result, timing: Timing) -> bytes:
        body = answer.final(result, timing)
        return event("final", body, media_type) + event("end", b"{}", media_type)

    plan = {"steps": {"of": worker.steps_of(request)}}
    events = worker.stream(request, final, preview, request_key=answer.id)
    streams.add(answer)

    def closed() -> None:
        streams.discard(answer)
        ended()

    return Stream(
        events,
        accepted=orjson.dumps(answer.head() | plan),
        media_type=media_type,
        failed=visit.failed,
        ended=closed,
    )


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


def _check_returned(returned: Sequence[str], media_type: str) -> None:
    if media_type in MOTIONS and "futures" not in returned:
        raise FieldError(
            pointer="/return",
            found=", ".join(returned),
            expected=f"{media_type} holds futures, so they must be among what is returned",
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
