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
from typing import TypeVar

NICENESS = 5
LIMIT = 2**21  # bytes read ahead: a whole answer, so that reading is seldom paused
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
    return asyncio.run(asyncio.wait_for(work, seconds + PATIENCE_S))


class _Connection:
    """Sends requests one after the other and reads whole answers."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    @classmethod
    async def to(cls, port: int) -> "_Connection":
        return cls(*await asyncio.open_connection("127.0.0.1", port, limit=LIMIT))

    async def head(self, asked: bytes) -> tuple[int, dict[str, str]]:
        self.writer.write(asked)
        first, *lines = (await self.reader.readuntil(b"\r\n\r\n")).decode().split("\r\n")
        return int(first.split()[1]), dict(line.lower().split(": ", 1) for line in lines if line)

    async def reply(self, asked: bytes, which: int = 0) -> Reply:
        sent_s = time.perf_counter()
        status, headers = await self.head(asked)
        await self.reader.readexactly(int(headers.get("content-length", 0)))
        seconds = time.perf_counter() - sent_s
        return Reply(which=which, sent_s=sent_s, seconds=seconds, status=status, headers=headers)


async def _closed(port: int, groups: Sequence[Group], until_s: float) -> list[list[Reply]]:
    async def client(group: Group) -> list[Reply]:
        connection = await _Connection.to(port)
        replies: list[Reply] = []
        while time.perf_counter() < until_s:
            which = len(replies) % len(group.requests)
            replies.append(await connection.reply(group.requests[which], which))
            await asyncio.sleep(group.pause_s)
        connection.writer.close()
        return replies

    async def together(group: Group) -> list[Reply]:
        found = await asyncio.gather(*(client(group) for _ in range(group.clients)))
        return [reply for replies in found for reply in replies]

    return await asyncio.gather(*(together(group) for group in groups))


async def _opened(port: int, asked: bytes, *, per_s: float, seconds: float) -> list[Reply]:
    idle: list[_Connection] = []
    replies: list[Reply] = []

    async def ask() -> None:
        sent_s = time.perf_counter()
        try:
            connection = idle.pop() if idle else await _Connection.to(port)
            replies.append(await connection.reply(asked))
            idle.append(connection)
        except (OSError, asyncio.IncompleteReadError):
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
        connection.writer.close()
    return replies


async def _left(port: int, asked: bytes, metric: str, after: float) -> float:
    leaver, watcher = await _Connection.to(port), await _Connection.to(port)

    async def value() -> float:
        _, headers = await watcher.head(request("GET", "/metrics"))
        text = await watcher.reader.readexactly(int(headers["content-length"]))
        return sum(map(float, re.findall(rf"(?m)^{metric}(?:{{.*}})? (\S+)$", text.decode())))

    before = now = await value()
    leaver.writer.write(asked)
    while now < before + after:
        now = await value()
    leaver.writer.transport.abort()
    watcher.writer.close()
    return now
