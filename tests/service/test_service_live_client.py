import asyncio
import socket
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import orjson
import pytest
from live import Live, until
from tiny_bundles import FPS, walking
from websockets.sync.client import connect

from service.asking.exchange import BadRequestError, ClientError, ConnectionFailedError
from service.client import AsyncClient, Client

WALK = walking(30)
TIMES = np.arange(30) / FPS


def test_client_gives_the_futures_of_what_it_pushes(bundles: Path):
    poses = WALK.copy()
    poses[-4, 8] = np.nan
    with Live(bundles) as live, Client(live.url) as client:
        with client.live(rate_hz=60.0, num_samples=np.int64(3), seed=5) as stream:
            for pose, t in zip(poses, TIMES, strict=True):
                stream.push(pose, t)
            newest = next(answer for answer in stream if answer.t == TIMES[-1])
            assert stream.latest() is None
        expected = client.predict(poses, timestamps=TIMES.tolist(), num_samples=3, seed=5)
    np.testing.assert_array_equal(newest.prediction.futures, expected.futures)
    assert newest.prediction.warnings == expected.warnings


def test_client_tells_what_each_joint_is_worth(bundles: Path):
    worth = np.random.default_rng(2).uniform(0.1, 1.0, WALK.shape[:2])
    with Live(bundles) as live, Client(live.url) as client:
        with client.live(rate_hz=60.0, num_samples=3, seed=5) as stream:
            for pose, t, sure in zip(WALK, TIMES, worth, strict=True):
                stream.push(pose, t, confidence=sure)
            newest = next(answer for answer in stream if answer.t == TIMES[-1])
        expected = client.predict(
            WALK, timestamps=TIMES.tolist(), fps=FPS, confidence=worth, num_samples=3, seed=5
        )
    np.testing.assert_array_equal(newest.prediction.futures, expected.futures)
    assert newest.prediction.warnings == expected.warnings


def test_time_is_now_where_none_is_given(bundles: Path):
    with Live(bundles) as live, Client(live.url) as client, client.live(num_samples=1) as stream:
        answer = None
        while answer is None:
            stream.push(WALK[-1])
            answer = stream.latest()
        assert answer.prediction.futures.shape == (1, 60, 21, 3)


def test_a_refused_frame_is_raised_and_the_stream_goes_on(bundles: Path):
    async def streamed(url: str) -> None:
        async with AsyncClient(url) as client, client.live(rate_hz=60.0, num_samples=1) as stream:
            stream.push(WALK[0][:5], 0.0)
            with pytest.raises(BadRequestError, match="pose: found an array of shape"):
                await anext(stream)
            for pose, t in zip(WALK, TIMES, strict=True):
                stream.push(pose, t)
            async for answer in stream:
                if answer.t == TIMES[-1]:
                    return

    with Live(bundles) as live:
        asyncio.run(streamed(live.url))


def test_options_that_are_refused_are_raised(bundles: Path):
    refused = pytest.raises(BadRequestError, match=r"options\.model: found 'x'")
    with Live(bundles) as live, Client(live.url).live(model="x") as stream, refused:
        next(stream)


def test_a_stranger_is_told_so(bundles: Path):
    with Live(bundles, api_keys="k") as live:
        with Client(live.url) as client, client.live() as stream:
            with pytest.raises(BadRequestError) as refused:
                next(stream)
            assert refused.value.slug == "unauthorised"
        with Client(live.url, api_key="k") as client, client.live(num_samples=1) as stream:
            for pose, t in zip(WALK, TIMES, strict=True):
                stream.push(pose, t)
            assert next(stream).prediction.model == "diffusion"


def test_no_server_is_an_error_and_not_a_wait():
    with socket.create_server(("127.0.0.1", 0)) as closed:
        port = closed.getsockname()[1]
    url, silence = f"http://127.0.0.1:{port}", pytest.raises(ConnectionFailedError, match="serve")
    with Client(url) as client, client.live() as stream, silence:
        next(stream)


def test_a_stream_outlives_its_server(bundles: Path):
    """Another server at the same address takes the stream on, of frames that come then."""
    with ExitStack() as client_side, socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with Live(bundles, listener=listener.dup()) as first:
            client = client_side.enter_context(Client(f"http://127.0.0.1:{port}"))
            stream = client_side.enter_context(client.live(rate_hz=60.0, num_samples=1))
            for pose, t in zip(WALK, TIMES, strict=True):
                stream.push(pose, t)
            assert next(stream).t <= TIMES[-1]
            assert len(first.app.state.streams) == 1
        with Live(bundles, listener=listener.dup()) as second:
            until(lambda: len(second.app.state.streams) == 1)
            for pose, t in zip(WALK, TIMES, strict=True):
                stream.push(pose, 10.0 + t)
            while next(stream).t < 10.0:
                pass


def test_a_stream_ends_when_another_connection_takes_its_session(bundles: Path):
    with Live(bundles) as live, Client(live.url) as client, client.live(num_samples=1) as stream:
        for pose, t in zip(WALK, TIMES, strict=True):
            stream.push(pose, t)
        session, _, _ = next(stream).prediction.id.rpartition("-")
        with connect(f"ws://127.0.0.1:{live.port}/stream") as thief:
            thief.send(orjson.dumps({"type": "start", "session": session}).decode())
            with pytest.raises(ClientError, match="resumed its session"):
                list(stream)
