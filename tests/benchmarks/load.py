"""Load on a server, from processes of their own that are nicer than it and import little.

Requests are bytes made beforehand and answers are read without being decoded, so that on two cores
as much as possible is left to the server. Times are seconds.
"""

import asyncio
import os
import re
import time
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar, cast

import uvloop

NICENESS = 5
READ_BYTES = 2**18
PATIENCE_S = 60.0

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, slots=True)
class Reply:
    """An answer, and which of the requests it is to."""

    which: int
    sent_s: float
    seconds: float
    status: int
    headers: dict[str, str]


@dataclass(frozen=True, kw_only=True, slots=True)
class Group:
    """Clients that ask again as soon as they are answered, or a pause later."""

    clients: int
    requests: Sequence[bytes]
    pause_s: float = 0.0


def be_nice() -> None:
    """Leave the cores to the server."""
    os.nice(NICENESS)


def spent() -> tuple[float, float]:
    """CPU seconds of this process so far, and how long it could have run, but had no core."""
    ran_and_waited = Path("/proc/self/schedstat").read_text().split()
    return time.process_time(), int(ran_and_waited[1]) / 1e9


def request(method: str, path: str, body: bytes = b"", **headers: str) -> bytes:
    """A request as it goes over the wire; the keyword ``content_type`` is a header's name."""
    fields = {"host": "127.0.0.1", "content-length": str(len(body))}
    fields |= {name.replace("_", "-"): value for name, value in headers.items()}
    lines = [f"{method} {path} HTTP/1.1", *(f"{name}: {value}" for name, value in fields.items())]
    return "\r\n".join([*lines, "", ""]).encode() + body


def closed(port: int, groups: Sequence[Group], seconds: float) -> list[list[Reply]]:
    """The answers to each group within so many seconds."""
    return _run(_closed(port, groups, time.perf_counter() + seconds), seconds)


def opened(port: int, asked: bytes, *, per_s: float, seconds: float) -> list[Reply]:
    """The answers to requests at a rate, however slow they are; of status 0 where there is none."""
    return _run(_opened(port, asked, per_s=per_s, seconds=seconds), seconds)


def leave(port: int, asked: bytes, *, metric: str, after: float) -> float:
    """Close the connection of a request once a metric of the server has risen by ``after``.

    The last value that was read before.
    """
    return _run(_left(port, asked, metric, after), 0.0)


def _run(work: Coroutine[None, None, T], seconds: float) -> T:
    """What the work gives; a server that does not answer for long fails it."""
    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        return runner.run(asyncio.wait_for(work, seconds + PATIENCE_S))


class _Connection(asyncio.BufferedProtocol):
    """Sends requests one after the other; of answers it keeps the head, and a body if asked to."""

    def __init__(self, *, keeps: bool) -> None:
        self._keeps = keeps
        self._read = memoryview(bytearray(READ_BYTES))
        self._head = b""
        self._left = 0
        self._status, self._headers = 0, dict[str, str]()
        self._ended: asyncio.Future[None] | None = None
        self.body = bytearray()

    @classmethod
    async def to(cls, port: int, *, keeps: bool = False) -> "_Connection":
        loop = asyncio.get_running_loop()
        _, connection = await loop.create_connection(lambda: cls(keeps=keeps), "127.0.0.1", port)
        return connection

    async def reply(self, asked: bytes, which: int = 0) -> Reply:
        sent_s = time.perf_counter()
        self._ended = asyncio.get_running_loop().create_future()
        self.body.clear()
        self.transport.write(asked)
        await self._ended
        return Reply(
            which=which,
            sent_s=sent_s,
            seconds=time.perf_counter() - sent_s,
            status=self._status,
            headers=self._headers,
        )

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)  # which uvloop's does not inherit

    def get_buffer(self, sizehint: int) -> memoryview:
        del sizehint
        return self._read

    def buffer_updated(self, nbytes: int) -> None:
        part: bytes | memoryview = self._read[:nbytes]
        if not self._left:
            head, end, part = (self._head + part).partition(b"\r\n\r\n")
            if not end:
                self._head = head
                return
            first, *lines = head.decode().split("\r\n")
            self._head, self._status = b"", int(first.split()[1])
            self._headers = dict(line.lower().split(": ", 1) for line in lines)
            self._left = int(self._headers.get("content-length", 0))
        self._left -= len(part)
        if self._keeps:
            self.body += part
        if not self._left and self._ended:
            self._ended.set_result(None)

    def connection_lost(self, exc: Exception | None) -> None:
        if self._ended and not self._ended.done():
            self._ended.set_exception(exc or ConnectionResetError("closed before its answer"))


async def _closed(port: int, groups: Sequence[Group], until_s: float) -> list[list[Reply]]:
    async def client(group: Group) -> list[Reply]:
        connection = await _Connection.to(port)
        replies: list[Reply] = []
        while time.perf_counter() < until_s:
            which = len(replies) % len(group.requests)
            replies.append(await connection.reply(group.requests[which], which))
            await asyncio.sleep(group.pause_s)
        connection.transport.close()
        return replies

    async def together(group: Group) -> list[Reply]:
        found = await asyncio.gather(*(client(group) for _ in range(group.clients)))
        return [reply for replies in found for reply in replies]

    return await asyncio.gather(*(together(group) for group in groups))


def _still_open(idle: list[_Connection]) -> _Connection | None:
    """One that the server has not closed meanwhile; those that it has are forgotten."""
    while idle:
        if not (connection := idle.pop()).transport.is_closing():
            return connection
    return None


async def _opened(port: int, asked: bytes, *, per_s: float, seconds: float) -> list[Reply]:
    idle: list[_Connection] = []
    replies: list[Reply] = []

    async def ask() -> None:
        sent_s = time.perf_counter()
        try:
            connection = _still_open(idle) or await _Connection.to(port)
            replies.append(await connection.reply(asked))
            idle.append(connection)
        except OSError:
            seconds = time.perf_counter() - sent_s
            replies.append(Reply(which=0, sent_s=sent_s, seconds=seconds, status=0, headers={}))

    started_s = time.perf_counter()
    async with asyncio.TaskGroup() as tasks:
        sent = 0
        while (passed_s := time.perf_counter() - started_s) < seconds:
            for _ in range(sent, int(passed_s * per_s)):
                tasks.create_task(ask())
                sent += 1
            await asyncio.sleep(0.002)
    for connection in idle:
        connection.transport.close()
    return replies


async def _left(port: int, asked: bytes, metric: str, after: float) -> float:
    leaver, watcher = await _Connection.to(port), await _Connection.to(port, keeps=True)

    async def value() -> float:
        await watcher.reply(request("GET", "/metrics"))
        found = re.findall(rf"(?m)^{metric}(?:{{.*}})? (\S+)$", watcher.body.decode())
        return sum(map(float, found))

    before = now = await value()
    leaver.transport.write(asked)
    while now < before + after:
        now = await value()
    leaver.transport.abort()
    watcher.transport.close()
    return now
