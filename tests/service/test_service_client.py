import asyncio
from collections.abc import AsyncIterator, Callable
from typing import Any, get_type_hints

import httpx
import numpy as np
import orjson
import pytest
from in_memory import Service
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from tiny_bundles import walking

from service import schemas
from service.asking.exchange import (
    BadRequestError,
    BusyError,
    ConnectionFailedError,
    CutStreamError,
    ServerFailedError,
)
from service.asking.messages import (
    ActionsOptions,
    ActionsPrediction,
    ActionsPreview,
    PredictOptions,
    Preview,
)
from service.client import AsyncClient, Client
from service.media import MSGPACK, decoded

OVERLOADED = {"type": "/problems/overloaded", "status": 429, "detail": "the queue is full."}


def test_client_gives_arrays(service: Service):
    with Client(transport=service) as client:
        poses = walking()
        poses[4, 8] = np.nan
        prediction = client.predict(
            poses, skeleton="body21", fps=30.0, num_samples=3, seed=5, request_id="mine"
        )
        assert prediction.futures.shape == (3, 60, 21, 3)
        assert (prediction.seed, prediction.fps, prediction.model) == (5, 30.0, "diffusion")
        assert (prediction.steps.run, prediction.steps.stopped_by) == (10, "end")
        assert prediction.id == "mine"
        assert prediction.joints[0] == "hips"
        assert "left_hand is null" in prediction.warnings[0]
        assert prediction.timing_ms["engine"] > 0.0
        assert client.models()["default"] == "diffusion"


def test_client_gives_modes_and_quantiles(service: Service):
    with Client(transport=service) as client:
        prediction = client.predict(
            walking(), num_samples=12, seed=5, returned=["modes", "quantiles"],
            num_modes=3, quantile_levels=[0.8],
        )  # fmt: skip
    assert prediction.futures.shape == (0, 60, 21, 3)
    assert sum(mode.probability for mode in prediction.modes) == pytest.approx(1.0)
    assert sorted(i for mode in prediction.modes for i in mode.members) == list(range(12))
    assert prediction.quantiles is not None
    assert prediction.quantiles.levels == (0.8,)
    assert prediction.quantiles.centre.shape == (60, 21, 3)
    assert prediction.quantiles.radius.shape == (1, 60, 21)


def test_client_stops_early_and_looks_further(service: Service):
    with Client(transport=service) as client:
        early = client.predict(walking(), num_samples=2, num_steps=3)
        assert (early.steps.run, early.steps.of, early.steps.stopped_by) == (3, 10, "num_steps")
        settled = client.predict(walking(), num_samples=2, tolerance_m=100.0)
        assert settled.steps.stopped_by == "tolerance"
        further = client.predict(walking(), num_samples=2, horizon_s=3.0)
        assert further.futures.shape[1] == 90
        in_time = client.predict(walking(), num_samples=2, deadline_ms=60_000.0)
        assert in_time.steps.run == 10


def test_client_gives_futures_of_actions_with_their_segments(performing_service: Service):
    with Client(transport=performing_service) as client:
        poses = walking()
        poses[4, 8] = np.nan
        prediction = client.predict_actions(poses, ["reach", "wave"], num_samples=4, seed=5)
        ends = [segments[-1].end for segments in prediction.segments]
        assert [future.shape for future in prediction.futures] == [(end, 21, 3) for end in ends]
        assert len(set(ends)) > 1
        reach, wave = prediction.segments[0]
        assert (reach.action, reach.start, reach.stopped) == ("reach", 0, True)
        assert (wave.action, wave.start) == ("wave", reach.end)
        assert (prediction.seed, prediction.fps, prediction.model) == (5, 30.0, "actions")
        assert "left_hand is null" in prediction.warnings[0]
        assert client.actions()["default_model"] == "actions"
        with pytest.raises(BadRequestError, match="the nearest is wave") as caught:
            client.predict_actions(poses, ["weave"])
        assert caught.value.problem["pointer"] == "/actions/0"


def test_awaited_client_gives_the_same_as_the_blocking_one(performing_service: Service):
    async def asked() -> tuple[Any, Any]:
        transport = httpx.ASGITransport(app=performing_service.app)
        async with AsyncClient(transport=transport) as client:
            first, second = await asyncio.gather(
                client.predict(walking(), num_samples=2, seed=5),
                client.predict_actions(walking(), ["reach"], num_samples=2, seed=5),
            )
            assert (await client.models())["default"] == "diffusion"
            assert (await client.actions())["default_model"] == "actions"
            assert not await client.cancel("nobody's")
        return first, second

    predicted, performed = performing_service.run(asked())
    with Client(transport=performing_service) as client:
        alone = client.predict(walking(), num_samples=2, seed=5)
        np.testing.assert_array_equal(predicted.futures, alone.futures)
        acted = client.predict_actions(walking(), ["reach"], num_samples=2, seed=5)
        np.testing.assert_array_equal(performed.futures[1], acted.futures[1])
        assert not client.cancel("nobody's")


def test_stream_gives_previews_and_then_the_prediction(service: Service):
    async def asked() -> list[Any]:
        transport = httpx.ASGITransport(app=service.app)
        async with AsyncClient(transport=transport) as client:
            return [event async for event in client.stream(walking(), num_samples=2, seed=5)]

    with Client(transport=service) as client:
        plain = client.predict(walking(), num_samples=2, seed=5)
        *previews, final = client.stream(walking(), num_samples=2, seed=5)
    *also_previews, also_final = service.run(asked())
    for events, last in ((previews, final), (also_previews, also_final)):
        assert all(isinstance(event, Preview) for event in events)
        assert all(event.futures.shape == (2, 60, 21, 3) for event in events)
        runs = [event.run for event in events]
        assert runs == sorted(set(runs))
        np.testing.assert_allclose(last.futures, plain.futures, atol=1e-6)
        assert (last.steps, last.seed) == (plain.steps, 5)


def test_stream_of_actions_gives_previews_and_then_the_prediction(performing_service: Service):
    options: ActionsOptions = {"num_samples": 2, "seed": 5}
    actions = ["reach", "wave"]

    async def asked() -> list[Any]:
        transport = httpx.ASGITransport(app=performing_service.app)
        async with AsyncClient(transport=transport) as client:
            stream = client.stream_actions(walking(), actions, **options)
            return [event async for event in stream]

    with Client(transport=performing_service) as client:
        plain = client.predict_actions(walking(), actions, **options)
        *previews, final = client.stream_actions(walking(), actions, **options)
        with pytest.raises(BadRequestError, match="found 'octopus'"):
            next(client.stream_actions(walking(), ["octopus"]))
    *also_previews, also_final = performing_service.run(asked())
    assert previews
    for events, last in ((previews, final), (also_previews, also_final)):
        runs = [event.run for event in events]
        assert runs == sorted(set(runs))
        for event in events:
            assert isinstance(event, ActionsPreview)
            assert event.of == 16
            ends = [segments[-1].end for segments in event.segments]
            assert [len(future) for future in event.futures] == ends
        assert isinstance(last, ActionsPrediction)
        assert last.segments == plain.segments
        for future, expected in zip(last.futures, plain.futures, strict=True):
            np.testing.assert_allclose(future, expected, atol=1e-6)


def test_options_are_those_of_the_service():
    for options, body in (
        (PredictOptions, schemas.PredictRequest),
        (ActionsOptions, schemas.PredictActionsRequest),
    ):
        fields = body.model_fields.keys() - {"poses", "actions"}
        assert get_type_hints(options).keys() - {"request_id"} == fields


def test_client_raises_what_the_server_says(service: Service):
    client = Client(transport=service)
    with pytest.raises(BadRequestError, match="found 'octopus'") as caught:
        client.predict(walking(), skeleton="octopus")
    assert (caught.value.status, caught.value.slug) == (422, "unknown-skeleton")
    assert caught.value.problem["pointer"] == "/skeleton"
    with pytest.raises(ServerFailedError, match="gave NaN"):
        client.predict(walking(speed=99.0))
    with pytest.raises(BadRequestError, match="found 'octopus'"):
        next(client.stream(walking(), skeleton="octopus"))


class Server:
    """A small real application that answers as it is told, try by try, and keeps what it read."""

    def __init__(self, *answers: Callable[[], Response]) -> None:
        self._answers = list(answers)
        self.bodies: list[dict[str, Any]] = []
        self.paths: list[str] = []

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        request = Request(scope, receive)
        content = await request.body()
        self.paths.append(f"{request.method} {request.url.path}")
        if content:
            self.bodies.append(decoded(content, MSGPACK, limit=len(content)))
        await self._answers.pop(0)()(scope, receive, send)

    def ask(self, **options: Any) -> Any:
        async def asked() -> Any:
            transport = httpx.ASGITransport(app=self)
            async with AsyncClient(transport=transport, attempts=3) as client:
                return await client.predict(walking(), **options)

        return asyncio.run(asked())

    def events(self) -> list[Any]:
        async def asked() -> list[Any]:
            async with AsyncClient(transport=httpx.ASGITransport(app=self)) as client:
                return [event async for event in client.stream(walking())]

        return asyncio.run(asked())


def busy(status: int = 429, retry_after: str = "0") -> Callable[[], Response]:
    return lambda: Response(
        orjson.dumps(OVERLOADED),
        status_code=status,
        media_type="application/problem+json",
        headers={"retry-after": retry_after},
    )


def answered() -> Response:
    content = {
        "id": "1", "model": {"name": "m"}, "seed": 1, "fps": 30.0, "joints": ["hips"],
        "joint_sources": ["observed"],
        "num_frames": 1, "futures": [[[[0.0, 0.0, 1.0]]]], "warnings": [],
        "steps": {"run": 1, "of": 1, "stopped_by": "end"}, "timing_ms": {"engine": 2.5},
    }  # fmt: skip
    return Response(orjson.dumps(content), media_type="application/json")


def streamed(*lines: bytes) -> Callable[[], Response]:
    async def body() -> AsyncIterator[bytes]:
        for line in lines:
            yield line

    return lambda: StreamingResponse(body(), media_type="application/x-ndjson")


def test_busy_server_is_asked_again_with_the_same_seed():
    server = Server(busy(429, "0.01"), busy(503), answered)
    assert server.ask().futures.shape == (1, 1, 1, 3)
    assert len(server.bodies) == 3
    assert len({body["seed"] for body in server.bodies}) == 1
    np.testing.assert_array_equal(server.bodies[0]["poses"], walking())


def test_server_is_asked_only_so_often():
    server = Server(busy(), busy(), busy(), answered)
    with pytest.raises(BusyError, match="the queue is full") as caught:
        server.ask()
    assert (len(server.bodies), caught.value.slug) == (3, "overloaded")


def test_server_that_is_busy_for_longer_than_the_client_has_is_not_asked_again():
    for options, retry_after in (({}, "3600"), ({"deadline_ms": 500.0}, "1")):
        server = Server(busy(429, retry_after), answered)
        with pytest.raises(BusyError) as caught:
            server.ask(**options)
        assert (len(server.bodies), caught.value.retry_after_s) == (1, float(retry_after))


def test_deadline_counts_from_the_first_try():
    server = Server(busy(429, "0.02"), answered)
    server.ask(deadline_ms=30_000.0)
    first, second = (body["deadline_ms"] for body in server.bodies)
    assert first <= 30_000.0
    assert second <= first - 20.0


def test_errors_that_stay_are_not_asked_again():
    server = Server(lambda: Response("<html>bad gateway</html>", status_code=502), answered)
    with pytest.raises(ServerFailedError, match="HTTP 502"):
        server.ask()
    assert len(server.bodies) == 1


def test_lost_connection_is_tried_again_with_the_same_seed():
    class Flaky(httpx.BaseTransport):
        """Loses the first connection after it has sent the request."""

        seeds: list[int] = []  # noqa: RUF012 - of this one test

        def handle_request(self, request: httpx.Request) -> httpx.Response:
            content = request.read()
            self.seeds.append(decoded(content, MSGPACK, limit=len(content))["seed"])
            if len(self.seeds) == 1:
                raise httpx.RemoteProtocolError("Server disconnected", request=request)
            return httpx.Response(200, content=answered().body,
                                  headers={"content-type": "application/json"})  # fmt: skip

    with Client(transport=Flaky()) as client:
        assert client.predict(walking()).model == "m"
    assert len(Flaky.seeds) == 2
    assert len(set(Flaky.seeds)) == 1


def test_client_says_that_nobody_answers():
    with (
        Client("http://127.0.0.1:1", attempts=2) as client,
        pytest.raises(ConnectionFailedError, match="found no server that answers"),
    ):
        client.models()


PREVIEW = (
    b'{"event":"preview","data":{"id":"1","steps":{"run":1,"of":2},"futures":[[[[0.0,0.0,1.0]]]]}}'
    b"\n"
)
FINAL = b'{"event":"final","data":' + bytes(answered().body) + b"}\n"


def test_stream_that_breaks_off_is_never_taken_for_whole():
    for lines in ([PREVIEW], [PREVIEW, FINAL], [PREVIEW, FINAL[:100]]):
        with pytest.raises(CutStreamError, match="found no end"):
            Server(streamed(*lines)).events()


def test_stream_raises_the_error_that_it_ends_with():
    problem = orjson.dumps({"type": "/problems/cancelled", "status": 409, "detail": "cancelled."})
    with pytest.raises(BadRequestError, match="cancelled") as caught:
        Server(streamed(PREVIEW, b'{"event":"error","data":' + problem + b"}\n")).events()
    assert caught.value.slug == "cancelled"


def test_stream_of_a_busy_server_is_asked_for_again():
    server = Server(busy(), streamed(PREVIEW, FINAL, b'{"event":"end"}\n'))
    preview, final = server.events()
    assert (preview.run, preview.of, final.timing_ms) == (1, 2, {"engine": 2.5})


def test_cancel_names_the_request():
    server = Server(lambda: Response(status_code=204))

    async def cancelled() -> bool:
        async with AsyncClient(transport=httpx.ASGITransport(app=server)) as client:
            return await client.cancel("a/b")

    assert asyncio.run(cancelled())
    assert server.paths == ["DELETE /requests/a/b"]


def test_key_is_sent():
    keys = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        keys.append(Request(scope, receive).headers["authorization"])
        await answered()(scope, receive, send)

    async def asked() -> None:
        async with AsyncClient(transport=httpx.ASGITransport(app=app), api_key="k1") as client:
            await client.predict(walking())

    asyncio.run(asked())
    assert keys == ["Bearer k1"]
