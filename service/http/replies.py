"""How an answer goes out over HTTP, whole or as a stream, and what is told of it."""

import asyncio
from collections.abc import Callable
from time import perf_counter

import orjson
from fastapi import Request, Response
from starlette.background import BackgroundTask

from service.answers.answer import Answer
from service.engine import trajectory
from service.errors import OverloadedError, UnavailableError
from service.http.delivery import Stream, event, unless_gone
from service.http.dependencies import metrics_of, settings_of, visit_of
from service.http.telemetry import record_stages
from service.http.visits import CLIENT_GONE
from service.media import MOTIONS, STREAMS
from service.worker import Timing, Worker


async def replied(
    http: Request, worker: Worker, request: trajectory.Request, answer: Answer
) -> Response:
    """The answer to a request, or the stream that ends with it.

    Raises:
        ServiceError: there is none, or no room for a stream.
    """
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

    async def answered() -> tuple[bytes, float]:
        return await worker.predict(request, answer.final, request_key=answer.id), perf_counter()

    async def sent() -> None:
        worker.sent(perf_counter() - answered_s)

    content, answered_s = await unless_gone(http, answered())
    ended()
    headers = {"Content-Type": answer.media_type}
    if answer.media_type in MOTIONS:
        content, headers = await asyncio.to_thread(answer.files)
        answered_s = perf_counter()  # making files says nothing of how long a way out is
    timing = ", ".join(f"{name};dur={ms}" for name, ms in answer.milliseconds().items())
    headers |= {"Server-Timing": timing}
    return Response(content, headers=headers, background=BackgroundTask(sent))


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
