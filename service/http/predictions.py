"""The paths that predict."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, Header, Request, Response

from service import schemas
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
    RateLimitedError,
    UnauthorisedError,
    UnavailableError,
    UnknownRequestError,
)
from service.http.body import BodyRoute
from service.http.dependencies import TheCatalog, TheSettings, visit_of
from service.http.plans import deadline_of, planned, prepared, prepared_actions
from service.http.problems import declared
from service.http.replies import replied
from service.media import BVH, DOCUMENTS, GLB, MOTIONS, MSGPACK, NPZ, STREAMS, ZIP, accepted

_RouteT = TypeVar("_RouteT", bound=Callable[..., Any])

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


def _with_version(method: str, path: str, **said: Any) -> Callable[[_RouteT], _RouteT]:
    """A route at its path, and at the same one under the version of the contract."""

    def added(route: _RouteT) -> _RouteT:
        name = route.__name__
        for prefix, operation_id in (("", name), ("/v1", f"{name}_v1")):
            router.add_api_route(
                prefix + path, route, methods=[method], operation_id=operation_id, **said
            )
        return route

    return added


def _predicts(path: str, answer: type[schemas.Answer]) -> Callable[[_RouteT], _RouteT]:
    return _with_version(
        "POST",
        path,
        response_model=answer,
        responses=_PROBLEMS | _ANSWERS,
        openapi_extra=_BODIES,
    )


@_predicts("/predict", schemas.PredictResponse)
async def predict(
    body: schemas.PredictRequest,
    http: Request,
    catalog: TheCatalog,
    settings: TheSettings,
    timeout_s: _TimeoutHeader = None,
) -> Response:
    """N futures of the person in the poses, in the caller's world, skeleton and frame rate."""
    media_type, visit = _accepted(http, body.returned), visit_of(http)
    plan = planned(body, catalog=catalog, settings=settings)
    request, answer = await prepared(
        body,
        plan,
        request_id=visit.request_id,
        media_type=media_type,
        deadline_s=deadline_of(body, arrived_s=visit.arrived_s, timeout_s=timeout_s),
    )
    return await replied(http, plan.worker, request, answer)


@_predicts("/predict_actions", schemas.PredictActionsResponse)
async def predict_actions(
    body: schemas.PredictActionsRequest,
    http: Request,
    catalog: TheCatalog,
    settings: TheSettings,
    timeout_s: _TimeoutHeader = None,
) -> Response:
    """N futures of the person in the poses, who performs the actions one after the other."""
    media_type, visit = _accepted(http, body.returned), visit_of(http)
    worker, request, answer = await prepared_actions(
        body,
        catalog=catalog,
        settings=settings,
        request_id=visit.request_id,
        media_type=media_type,
        deadline_s=deadline_of(body, arrived_s=visit.arrived_s, timeout_s=timeout_s),
    )
    return await replied(http, worker, request, answer)


@_with_version(
    "DELETE",
    "/requests/{request_id}",
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


def _accepted(http: Request, returned: Sequence[str]) -> str:
    """The media type of the answer, which has to hold what is returned."""
    media_type = accepted(http.headers.get("accept", ""), (*DOCUMENTS, *STREAMS, *MOTIONS))
    if media_type in MOTIONS and "futures" not in returned:
        raise FieldError(
            pointer="/return",
            found=", ".join(returned),
            expected=f"{media_type} holds futures, so they must be among what is returned",
        )
    return media_type
