"""WS /stream: frames of a person come at any rate, futures of the latest go at the chosen one.

The client says ``start``, and then ``frame`` after ``frame``; the server says ``ready``, and then
``futures``, or ``waiting`` while it has not seen enough, or ``error``, after which all goes on.
Messages of text are JSON, of bytes MessagePack; the server's are as the ``start`` was. At most one
prediction of a connection is under way, of the latest frames when it begins, and only when the one
before it has been sent: nothing queues up, however slowly it is read.

Where the server wants a key, browsers, which cannot set ``Authorization`` here, offer two
protocols: ``posefutures``, which is taken, and ``posefutures.bearer.`` before the key in base64url.
"""

import asyncio
import re
from contextlib import suppress
from time import perf_counter
from typing import Any, TypeVar

import numpy as np
from fastapi import APIRouter, WebSocket
from jaxtyping import Shaped
from pydantic import BaseModel, ValidationError
from starlette.types import Message
from starlette.websockets import WebSocketDisconnect

from service.errors import (
    BodyTooLargeError,
    FieldError,
    OverloadedError,
    ServiceError,
    UnavailableError,
)
from service.http.guard import STREAM_PROTOCOL
from service.http.plans import Plan, deadline_of, planned, prepared, seed_of
from service.http.problems import content_of, field_error, problem
from service.live.sessions import Frame, Session, Watch
from service.media import JSON, MSGPACK, decoded, encoded
from service.observation import frames_needed
from service.poses.arrays import confidence_array, poses_array, shown
from service.poses.skeletons import requested_skeleton, sent_joints
from service.schemas import PredictRequest, StreamFrame, StreamStart

MAX_MESSAGE_BYTES = 2**16
RESTARTING, TAKEN = 1012, 4409  # why the server closes a connection
CLOSING_S = 1.0

router = APIRouter()

_BodyT = TypeVar("_BodyT", bound=BaseModel)
_TOLD_BY_FRAMES = ("poses", "timestamps", "confidence")


@router.websocket("/v1/stream")
@router.websocket("/stream")
async def stream(socket: WebSocket) -> None:
    """Futures of the latest frames, until the client leaves or the server ends."""
    streams: set[object] = socket.app.state.streams
    try:
        _check_room(socket, len(streams))
    except ServiceError as error:
        socket.state.visit.failed(error)
        await socket.send_denial_response(problem(error))
        return
    streams.add(socket)
    connection = _Connection(socket)
    try:
        offered = socket.scope["subprotocols"]
        await socket.accept(STREAM_PROTOCOL if STREAM_PROTOCOL in offered else None)
        await connection.run()
    finally:
        streams.discard(socket)
        connection.leave()


class _Connection:
    """One client: what it last asked for, and what it has to be told."""

    def __init__(self, socket: WebSocket) -> None:
        self._socket = socket
        self._state = socket.app.state
        self._facts: dict[str, Any] = socket.state.visit.facts
        self._facts |= {"frames": 0, "answers": 0, "problems": 0}
        self._session: Session | None = None
        self._taken = asyncio.Event()
        self._body = PredictRequest(poses=[])
        self._period_s = 0.0
        self._media_type = JSON
        self._news = asyncio.Event()
        # Of each type the latest message that has not been sent.
        self._unsent: dict[str, dict[str, Any]] = {}

    async def run(self) -> None:
        """Take what comes and tell what there is, until one of them ends."""
        work = (self._listen(), self._speak(), self._taken.wait())
        tasks = [asyncio.ensure_future(part) for part in work]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                task.result()
        except WebSocketDisconnect:  # while something was sent
            return
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
        if self._taken.is_set():
            await self._close(TAKEN, "the session goes on over another connection")

    def leave(self) -> None:
        """Keep the session for a connection that resumes it."""
        if self._session is not None and self._session.taken is self._taken:
            self._state.sessions.leave(self._session)

    async def _listen(self) -> None:
        while (message := await self._socket.receive())["type"] != "websocket.disconnect":
            try:
                self._take(message)
            except ServiceError as error:
                self._complain(error)
            self._news.set()

    def _take(self, message: Message) -> None:
        text = message.get("text")
        media_type = MSGPACK if text is None else JSON
        content = _content(message["bytes"] if text is None else text.encode(), media_type)
        kind = content.get("type")
        if kind == "start":
            self._media_type = media_type
            self._begin(content)
        elif kind == "frame":
            self._see(content)
        else:
            found = "nothing" if kind is None else shown(kind)
            raise FieldError(pointer="/type", found=found, expected='must be "start" or "frame"')

    def _begin(self, content: dict[str, Any]) -> None:
        start = _checked(StreamStart, content)
        for field in start.options.keys() & _TOLD_BY_FRAMES:
            raise FieldError(
                pointer=f"/options/{field}",
                found="a field that no stream has",
                expected="the frames tell it",
            )
        body = _checked(PredictRequest, {**start.options, "poses": []}, within="/options")
        try:
            manifest = self._planned(body).manifest
            joints = sent_joints(requested_skeleton(body.caller_skeleton(), manifest))
        except FieldError as error:
            raise _at(error, f"/options{error.pointer}") from error
        watch = Watch(
            joints=tuple(joints),
            axes=body.axes.axes(),
            fps=body.fps or manifest.fps,
            num_frames=frames_needed(manifest, body.fps or manifest.fps),
        )
        self._session = session = self._opened(start.session, watch)
        self._body = body.model_copy(update={"seed": seed_of(body), "fps": watch.fps})
        self._period_s = 1.0 / start.rate_hz
        self._facts["model"] = manifest.name
        self._unsent["ready"] = {
            "type": "ready",
            "session": session.id,
            "resumed": bool(session.history.frames),
            "model": manifest.name,
            "joints": list(joints),
            "fps": watch.fps,
            "num_observed": watch.num_frames,
        }

    def _opened(self, session_id: str | None, watch: Watch) -> Session:
        """The session of this id, or else the connection's own, or a new one."""
        mine = self._session
        if mine is not None and session_id not in (None, mine.id):
            self.leave()
        elif mine is not None and mine.taken is self._taken:
            session_id = mine.id
        session: Session = self._state.sessions.open(session_id, watch=watch, taken=self._taken)
        return session

    def _see(self, content: dict[str, Any]) -> None:
        if self._session is None:
            raise FieldError(pointer="/type", found='"frame"', expected='"start" comes first')
        frame = _checked(StreamFrame, content)
        num_joints, worth = len(self._session.watch.joints), None
        try:
            (pose,) = poses_array(_alone(frame.pose), num_joints=num_joints)
            if frame.confidence is not None:
                (worth,) = confidence_array(
                    _alone(frame.confidence), num_frames=1, num_joints=num_joints
                )
        except FieldError as error:
            pointer = re.sub("^/poses(/0)?", "/pose", error.pointer or "")
            raise _at(error, re.sub("^/confidence/0", "/confidence", pointer)) from error
        self._session.history.add(Frame(t=frame.t, pose=pose, confidence=worth))
        self._facts["frames"] += 1

    async def _speak(self) -> None:
        """Tell what there is to tell at once, and futures when it is time and there are frames."""
        now = asyncio.get_running_loop().time
        due_s = now()
        while not self._state.draining:
            for kind in list(self._unsent):
                await self._send(encoded(self._unsent.pop(kind), self._media_type))
            session, wait_s = self._session, None
            if session is not None and session.is_unanswered:
                wait_s = due_s - now()
                if wait_s <= 0.0:
                    # In time with the rate, as long as a frame is not late by more than a period.
                    due_s = (due_s if wait_s > -self._period_s else now()) + self._period_s
                    due_s = max(due_s, now() + await self._answer(session))
                    continue
            with suppress(TimeoutError):
                async with asyncio.timeout(wait_s):
                    await self._news.wait()
            self._news.clear()
        self._complain(_stopping())
        await self._send(encoded(self._unsent["error"], self._media_type))
        await self._close(RESTARTING, "the server is stopping")

    async def _answer(self, session: Session) -> float:
        """Answer the latest frames, and return the seconds after which it may help to ask again."""
        history = session.history
        session.answered_s = history.newest_s
        if not history.suffices:
            told = {"have_s": round(history.have_s, 3), "need_s": round(history.need_s, 3)}
            self._unsent["waiting"] = {"type": "waiting", **told}
            return 0.0
        try:
            content = await self._predicted(session)
        except ServiceError as error:
            self._complain(error, t=session.answered_s)
            return error.retry_after_s or 0.0
        self._facts["answers"] += 1
        await self._send(content)
        return 0.0

    async def _predicted(self, session: Session) -> bytes:
        body = self._body.model_copy(update=session.history.observed())
        arrived_s = perf_counter()
        session.num_answers += 1
        async with self._socket.state.admitted():
            plan = self._planned(body)
            request, answer = await prepared(
                body,
                plan,
                request_id=f"{session.id}-{session.num_answers}",
                media_type=self._media_type,
                deadline_s=deadline_of(body, arrived_s=arrived_s),
                beside={"type": "futures", "t": session.answered_s},
            )
            return await plan.worker.predict(request, answer.final, request_key=answer.id)

    def _planned(self, body: PredictRequest) -> Plan:
        return planned(body, catalog=self._state.catalog, settings=self._state.settings)

    def _complain(self, error: ServiceError, *, t: float | None = None) -> None:
        """Tell of an error, of the answer to the frames until ``t`` where it is one."""
        self._facts["problems"] += 1
        told = content_of(error, status=error.status) | ({} if t is None else {"t": t})
        self._unsent["error"] = {"type": "error", "problem": told}

    async def _send(self, content: bytes) -> None:
        if self._media_type == JSON:
            await self._socket.send_text(content.decode())
        else:
            await self._socket.send_bytes(content)

    async def _close(self, code: int, reason: str) -> None:
        with suppress(TimeoutError, WebSocketDisconnect):  # it may be lost already
            async with asyncio.timeout(CLOSING_S):
                await self._socket.close(code, reason)


def _check_room(socket: WebSocket, num_streams: int) -> None:
    if socket.app.state.draining:
        raise _stopping()
    most = socket.app.state.settings.max_streams
    if num_streams >= most:
        raise OverloadedError(
            f"the server: found {num_streams} open streams; it has at most {most}.",
            retry_after_s=1.0,
        )


def _content(message: bytes, media_type: str) -> dict[str, Any]:
    if len(message) > MAX_MESSAGE_BYTES:
        raise BodyTooLargeError(
            f"the message: found {len(message)} bytes; at most {MAX_MESSAGE_BYTES} are read.",
            found=f"{len(message)} bytes",
            expected=f"at most {MAX_MESSAGE_BYTES} bytes",
        )
    return decoded(message, media_type, limit=MAX_MESSAGE_BYTES)


def _checked(model: type[_BodyT], content: dict[str, Any], *, within: str = "") -> _BodyT:
    try:
        return model.model_validate(content)
    except ValidationError as error:
        wrong = field_error(error.errors(), content)
        raise _at(wrong, f"{within}{wrong.pointer}") from error


def _alone(values: list[Any] | Shaped[np.ndarray, "..."]) -> list[Any] | Shaped[np.ndarray, "..."]:
    """What one frame tells, as that of all frames of a request."""
    return values[None] if isinstance(values, np.ndarray) else [values]


def _at(error: FieldError, pointer: str) -> FieldError:
    """The same, of a field that a message has elsewhere than a request."""
    return type(error)(pointer=pointer, found=error.found, expected=error.expected)


def _stopping() -> UnavailableError:
    return UnavailableError("the server is stopping; ask another one, or again in a second.")
