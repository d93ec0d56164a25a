"""WS /stream: what goes in and out of it, and that nothing of it piles up."""

import asyncio
from base64 import urlsafe_b64encode
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from in_memory import Service, dumped, untimed
from in_memory_stream import Stream, nulled
from live import Live, until
from tiny_bundles import FPS, walking
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from service.app import drain

WALK = walking(30)
TIMES = np.arange(30) / FPS
OPTIONS = {"skeleton": "body21", "num_samples": 2, "seed": 4}


@pytest.mark.parametrize("path", ["/stream", "/v1/stream"])
def test_futures_are_those_that_predict_gives_for_the_same_frames(service: Service, path: str):
    poses = WALK.copy()
    poses[-4, 8] = np.nan

    async def streamed() -> tuple[dict[str, Any], list[dict[str, Any]]]:
        async with Stream(service.app, path=path) as stream:
            stream.start(**OPTIONS)
            ready = await stream.said()
            stream.push(poses, TIMES)
            answers = [await stream.said_of("futures")]
            while answers[-1]["t"] < TIMES[-1]:
                answers.append(await stream.said_of("futures"))
            return ready, answers

    ready, answers = service.run(streamed())
    for message in answers:
        count = round(message["t"] * FPS) + 1
        seen = {"poses": [nulled(pose) for pose in poses[:count]], "timestamps": TIMES[:count]}
        body = dumped(seen | {"fps": 30.0} | OPTIONS)
        headers = {"content-type": "application/json", "x-request-id": message["answer"]["id"]}
        plain = service.request("POST", "/predict", content=body, headers=headers).content
        assert untimed(orjson.dumps(message["answer"])) == untimed(
            orjson.dumps(orjson.loads(plain))
        )
    assert "left_hand is null in 1 of the last 17" in answers[-1]["answer"]["warnings"][0]
    assert ready["joints"] == answers[-1]["answer"]["joints"]
    assert (ready["fps"], ready["num_observed"], ready["resumed"]) == (30.0, 15, False)


def test_message_has_the_bytes_that_predict_answers_with(bundles: Path, service: Service):
    with Live(bundles) as live, connect(f"ws://127.0.0.1:{live.port}/stream") as socket:
        socket.send(orjson.dumps({"type": "start", "options": OPTIONS}).decode())
        assert orjson.loads(socket.recv())["type"] == "ready"
        for pose, t in zip(WALK, TIMES, strict=True):
            socket.send(dumped({"type": "frame", "t": t, "pose": pose}).decode())
        newest = 0.0
        while newest < TIMES[-1]:
            message = socket.recv(decode=False)
            assert isinstance(message, bytes)
            newest = orjson.loads(message).get("t", 0.0)
    answer = message[message.index(b'"answer":') + 9 : -1]
    plain = service.request(
        "POST",
        "/predict",
        content=dumped({"poses": WALK, **OPTIONS}),
        headers={
            "content-type": "application/json", "x-request-id": orjson.loads(answer)["id"]
        },
    ).content  # fmt: skip
    assert untimed(answer) == untimed(plain)


def test_packed_messages_are_answered_with_packed_ones(service: Service):
    poses = WALK.copy()
    poses[-4, 8] = np.nan

    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.say_packed(type="start", rate_hz=60.0, options=OPTIONS | {"num_samples": 3})
            for pose, t in zip(poses, TIMES, strict=True):
                stream.say_packed(type="frame", t=t, pose=pose)
            while (message := await stream.said_of("futures"))["t"] < TIMES[-1]:
                pass
            return message["answer"]

    answer = service.run(streamed())
    expected = service.futures([nulled(pose) for pose in poses], **OPTIONS | {"num_samples": 3})
    np.testing.assert_array_equal(answer["futures"], expected.astype(np.float32))


def test_it_waits_until_it_has_seen_enough(service: Service):
    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            stream.push(WALK[:7], TIMES[:7])
            waiting = await stream.said_of("waiting")
            stream.push(WALK[7:15], TIMES[7:15])
            answer = await stream.said_of("futures")
            assert answer["t"] == TIMES[14]
            return waiting

    waiting = service.run(streamed())
    assert waiting == {"type": "waiting", "have_s": pytest.approx(waiting["have_s"]),
                       "need_s": pytest.approx(14 / FPS, abs=1e-3)}  # fmt: skip
    assert waiting["have_s"] < waiting["need_s"]


def test_a_pause_begins_anew(service: Service):
    async def streamed() -> None:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            stream.push(WALK, TIMES)
            while (await stream.said_of("futures"))["t"] < TIMES[-1]:
                pass
            stream.push(WALK[:1], np.array([9.0]))
            assert (await stream.said_of("waiting"))["have_s"] == 0.0

    service.run(streamed())


BAD = {
    "a frame of too few joints": (
        {"type": "frame", "t": 5.0, "pose": WALK[0][:20]},
        ("/problems/invalid-poses", "/pose", "20 joints"),
    ),
    "a joint of two numbers": (
        {"type": "frame", "t": 5.0, "pose": [[1.0, 2.0], *WALK[0][1:].tolist()]},
        ("/problems/invalid-poses", "/pose/0", "a list of 2"),
    ),
    "a coordinate that is text": (
        {"type": "frame", "t": 5.0, "pose": [["x", 2.0, 3.0], *WALK[0][1:].tolist()]},
        ("/problems/invalid-poses", "/pose/0/0", '"x"'),
    ),
    "a confidence too many": (
        {"type": "frame", "t": 5.0, "pose": WALK[0], "confidence": [1.0] * 22},
        ("/problems/invalid-field", "/confidence", "a list of 22"),
    ),
    "a confidence over 1": (
        {"type": "frame", "t": 5.0, "pose": WALK[0], "confidence": [1.0] * 20 + [1.5]},
        ("/problems/invalid-field", "/confidence/20", "1.5"),
    ),
    "a confidence under 0": (
        {"type": "frame", "t": 5.0, "pose": WALK[0], "confidence": [-0.1] + [1.0] * 20},
        ("/problems/invalid-field", "/confidence/0", "-0.1"),
    ),
    "a confidence that is null": (
        {"type": "frame", "t": 5.0, "pose": WALK[0], "confidence": [None] * 21},
        ("/problems/invalid-field", "/confidence/0", "null"),
    ),
    "a confidence for all joints": (
        {"type": "frame", "t": 5.0, "pose": WALK[0], "confidence": 0.5},
        ("/problems/invalid-field", "/confidence", "0.5"),
    ),
    "no pose": (
        {"type": "frame", "t": 5.0},
        ("/problems/invalid-field", "/pose", "nothing"),
    ),
    "a time that is text": (
        {"type": "frame", "t": "soon", "pose": WALK[0]},
        ("/problems/invalid-field", "/t", '"soon"'),
    ),
    "a time that was": (
        {"type": "frame", "t": TIMES[-1], "pose": WALK[0]},
        ("/problems/invalid-field", "/t", f"{TIMES[-1]:g} s"),
    ),
    "a type that is not known": (
        {"type": "farewell"},
        ("/problems/invalid-field", "/type", '"farewell"'),
    ),
    "no type": ({}, ("/problems/invalid-field", "/type", "nothing")),
    "an unknown field": (
        {"type": "frame", "t": 5.0, "pose": WALK[0], "score": 1.0},
        ("/problems/invalid-field", "/score", "a field that is not known"),
    ),
    "an option out of range": (
        {"type": "start", "options": {"num_samples": 0}},
        ("/problems/invalid-field", "/options/num_samples", "0"),
    ),
    "more samples than there are": (
        {"type": "start", "options": {"num_samples": 10**6}},
        ("/problems/invalid-field", "/options/num_samples", "1000000"),
    ),
    "poses among the options": (
        {"type": "start", "options": {"poses": []}},
        ("/problems/invalid-field", "/options/poses", "a field that no stream has"),
    ),
    "confidence among the options": (
        {"type": "start", "options": {"confidence": [[1.0] * 21]}},
        ("/problems/invalid-field", "/options/confidence", "a field that no stream has"),
    ),
    "an unknown model": (
        {"type": "start", "options": {"model": "x"}},
        ("/problems/unknown-model", "/options/model", "'x'"),
    ),
    "an unknown skeleton": (
        {"type": "start", "options": {"skeleton": "x"}},
        ("/problems/unknown-skeleton", "/options/skeleton", "'x'"),
    ),
    "a rate of none": (
        {"type": "start", "rate_hz": 0},
        ("/problems/invalid-field", "/rate_hz", "0"),
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_bad_message_is_a_problem_and_the_session_goes_on(service: Service, case: str):
    bad, (slug, pointer, found) = BAD[case]

    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            stream.push(WALK, TIMES)
            while (await stream.said_of("futures"))["t"] < TIMES[-1]:
                pass
            stream.say(**bad)
            error = await stream.said()
            stream.push(WALK[-1:], TIMES[-1:] + 1 / FPS)
            assert (await stream.said_of("futures"))["t"] == TIMES[-1] + 1 / FPS
            return error

    error = service.run(streamed())
    assert error["type"] == "error"
    problem = error["problem"]
    assert (problem["type"], problem["pointer"], problem["found"]) == (slug, pointer, found)
    assert problem["status"] == 422
    assert problem["expected"]


def test_messages_that_are_no_objects_or_too_large_are_problems(service: Service):
    async def streamed(text: str) -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.say_text(text)
            error = await stream.said()
            stream.start(**OPTIONS)
            assert (await stream.said())["type"] == "ready"
            return error["problem"]

    for text, status in {"[]": 400, "{": 400, '{"a": "' + "b" * 2**16 + '"}': 413}.items():
        assert service.run(streamed(text))["status"] == status


def test_a_frame_before_the_start_is_a_problem(service: Service):
    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.push(WALK[:1], TIMES[:1])
            return (await stream.said())["problem"]

    assert "start" in service.run(streamed())["expected"]


def test_what_no_person_does_is_a_problem_of_the_answer(service: Service):
    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            stream.push(100.0 * WALK[:15], TIMES[:15])
            while (message := await stream.said())["type"] != "error":
                pass
            return message["problem"]

    problem = service.run(streamed())
    assert (problem["pointer"], problem["status"]) == ("/axes/units", 422)


def test_uneven_frames_of_an_even_motion_are_answered_as_even_ones(service: Service):
    """Every joint moves along a line, so that any time between two frames is known exactly."""
    step = np.array([0.02, 0.01, 0.0])
    even = WALK[-1] + (np.arange(31) - 30)[:, None, None] * step
    drawn = np.random.default_rng(3).uniform(0.001, 0.06, 40).cumsum()
    times = np.append(drawn[drawn < 0.99], 1.0)
    poses = WALK[-1] + 30.0 * (times - 1.0)[:, None, None] * step

    async def streamed() -> np.ndarray:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS, fps=30.0)
            stream.push(poses, times)
            while (message := await stream.said_of("futures"))["t"] < 1.0:
                pass
            return np.array(message["answer"]["futures"])

    expected = service.futures(even, **OPTIONS, fps=30.0)
    np.testing.assert_allclose(service.run(streamed()), expected, atol=2e-4)


def test_doubted_frames_at_uneven_times_are_answered_as_predict_answers_them(service: Service):
    rng = np.random.default_rng(5)
    times = TIMES + rng.uniform(0.0, 0.02, len(TIMES))
    poses = WALK + rng.normal(0.0, 0.02, WALK.shape)
    worth = rng.uniform(0.1, 1.0, WALK.shape[:2])
    worth[::3] = 1.0  # what a frame is worth that says nothing of it

    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            for i, (t, pose) in enumerate(zip(times, poses, strict=True)):
                told = {"confidence": worth[i]} if i % 3 else {}
                if i % 2:
                    stream.say_packed(type="frame", t=t, pose=pose, **told)
                else:
                    stream.say(type="frame", t=t, pose=pose, **told)
            while (message := await stream.said_of("futures"))["t"] < times[-1]:
                pass
            return message["answer"]

    answer = service.run(streamed())
    seen = {"poses": poses, "timestamps": times.tolist(), "confidence": worth, "fps": 30.0}
    expected = service.futures(**seen, **OPTIONS)
    np.testing.assert_array_equal(answer["futures"], expected)
    sure = service.futures(**seen | {"confidence": None}, **OPTIONS)
    assert np.abs(sure - expected).max() > 1e-3


def test_a_confidence_that_is_no_number_is_a_problem(service: Service):
    async def streamed(worth: np.ndarray) -> dict[str, Any]:
        async with Stream(service.app) as stream:
            stream.say_packed(type="start", options=OPTIONS)
            assert (await stream.said())["type"] == "ready"
            stream.say_packed(type="frame", t=0.0, pose=WALK[0], confidence=worth)
            return (await stream.said())["problem"]

    unsure = np.full(21, 0.5)
    unsure[7] = np.nan
    for worth, pointer, found in (
        (unsure, "/confidence/7", "NaN"),
        (np.full((1, 21), 0.5), "/confidence", "a list of 1"),
        (np.array(0.5), "/confidence", "0.5"),
    ):
        problem = service.run(streamed(worth))
        assert (problem["pointer"], problem["found"]) == (pointer, found)


def test_a_reader_that_stops_gets_the_newest_when_it_reads_on(service: Service):
    frames = np.concatenate([WALK, np.repeat(WALK[-1:], 500, axis=0)])
    times = np.arange(len(frames)) / FPS

    async def streamed() -> list[float]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            assert (await stream.said())["type"] == "ready"
            stream.push(WALK, TIMES)
            while (await stream.said_of("futures"))["t"] < TIMES[-1]:
                pass
            stream.stop_reading()
            stream.push(frames[30:31], times[30:31])
            await stream.all_taken()
            for bad in range(100):
                stream.say(type=str(bad))
            stream.push(frames[31:], times[31:])
            await stream.all_taken()
            stream.read_on()
            told = [await stream.said()]
            while told[-1].get("t") != times[-1]:
                told.append(await stream.said())
            # One was under way, and one problem of a hundred is left.
            assert [message["type"] for message in told].count("error") == 1
            return [message["t"] for message in told if message["type"] == "futures"]

    answered = service.run(streamed())
    assert len(answered) <= 2
    assert answered[-1] == times[-1]


def test_one_prediction_is_under_way_however_fast_frames_come(bundles: Path):
    settings = {"max_samples": 1000, "max_poses": 10**6, "rows_per_step": 1, "workers": 1}
    with Live(bundles, **settings) as live:
        with connect(f"ws://127.0.0.1:{live.port}/stream", max_size=None) as socket:
            options = OPTIONS | {"num_samples": 20}
            socket.send(orjson.dumps({"type": "start", "rate_hz": 60, "options": options}).decode())
            loads = set()
            for t in range(150):
                frame = {"type": "frame", "t": t / FPS, "pose": WALK[0]}
                socket.send(dumped(frame).decode())
                loads.add(live.under_way())
            until(lambda: live.under_way() == 1)
            assert loads <= {0, 1}
        until(lambda: live.under_way() == 0)  # its client has left


def test_a_lost_connection_is_resumed_with_its_frames(service: Service):
    async def streamed() -> tuple[dict[str, Any], ...]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            first = await stream.said()
            stream.push(WALK, TIMES)
            while (last := await stream.said_of("futures"))["t"] < TIMES[-1]:
                pass
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS, session=first["session"])
            second = await stream.said()
            again = await stream.said()
            stream.push(WALK[-1:], TIMES[-1:] + 1 / FPS)
            assert (await stream.said_of("futures"))["t"] == TIMES[-1] + 1 / FPS
            return first, last, second, again

    first, last, second, again = service.run(streamed())
    assert second == first | {"resumed": True}
    assert (again["type"], again["t"]) == ("futures", last["t"])
    assert again["answer"]["futures"] == last["answer"]["futures"]
    assert again["answer"]["id"] != last["answer"]["id"]


def test_a_session_of_other_joints_or_that_nobody_knows_begins_anew(service: Service):
    async def streamed() -> list[dict[str, Any]]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            told = [await stream.said()]
            stream.push(WALK[:15], TIMES[:15])
            await stream.said_of("futures")
        for session, skeleton in ((told[0]["session"], "smpl22"), ("nobody", "body21")):
            async with Stream(service.app) as stream:
                stream.start(**OPTIONS | {"skeleton": skeleton}, session=session)
                told.append(await stream.said())
        return told

    first, other, unknown = service.run(streamed())
    assert (other["session"], other["resumed"]) == (first["session"], False)
    assert unknown["session"] not in (first["session"], "nobody")
    assert not unknown["resumed"]


def test_who_resumes_a_session_takes_it_from_a_connection_that_hangs(service: Service):
    async def streamed() -> dict[str, Any]:
        async with Stream(service.app) as old, Stream(service.app) as new:
            old.start(**OPTIONS)
            ready = await old.said()
            new.start(**OPTIONS, session=ready["session"])
            assert (await new.said())["session"] == ready["session"]
            return await old.said()

    assert service.run(streamed()) == {"type": "close", "code": 4409}


def test_another_start_asks_for_something_else_about_the_same_frames(service: Service):
    async def streamed() -> list[dict[str, Any]]:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            told = [await stream.said()]
            stream.push(WALK[:15], TIMES[:15])
            while told[-1].get("t") != TIMES[14]:
                told.append(await stream.said())
            stream.start(**OPTIONS | {"num_samples": 3})
            return [told[0], await stream.said(), await stream.said()]

    before, after, answer = service.run(streamed())
    assert after == before | {"resumed": True}
    assert len(answer["answer"]["futures"]) == 3


def test_seed_is_drawn_once_for_a_stream(service: Service):
    async def streamed() -> set[int]:
        async with Stream(service.app) as stream:
            stream.start(num_samples=1)
            seeds = set()
            for first in (0, 15):
                stream.push(WALK[first : first + 15], TIMES[first : first + 15])
                seeds.add((await stream.said_of("futures"))["answer"]["seed"])
            return seeds

    (seed,) = service.run(streamed())
    assert seed != service.run(streamed()).pop()


@pytest.fixture
def strict(bundles: Path) -> Iterator[Service]:
    with Service.of(bundles, api_keys="k", rate_limit="2/hour", max_streams=1) as running:
        running.wait_until_loaded()
        yield running


def test_streams_need_a_key_and_there_are_so_many(strict: Service):
    async def opened() -> list[dict[str, Any]]:
        streams = [Stream(strict.app, key=key) for key in (None, "k", "k")]
        async with streams[0], streams[1], streams[2]:
            return [stream.opening for stream in streams]

    stranger, first, second = strict.run(opened())
    assert stranger["status"] == 401
    assert first["type"] == "websocket.accept"
    assert second["status"] == 429
    headers = dict(second["headers"])
    assert headers[b"content-type"] == b"application/problem+json"
    assert headers[b"retry-after"] == b"1"


KEY = "k\N{LATIN SMALL LETTER SHARP S}/+ ?~\N{SNOWMAN}"


def key_protocol(key: str) -> str:
    return "posefutures.bearer." + urlsafe_b64encode(key.encode()).decode().rstrip("=")


@pytest.mark.parametrize(
    ("protocols", "status"),
    [
        (["posefutures", key_protocol(KEY)], 101),
        ([key_protocol(KEY), "posefutures"], 101),
        (["posefutures", key_protocol("wrong")], 401),
        (["posefutures", "posefutures.bearer."], 401),
        (["posefutures", "posefutures.bearer.A"], 401),
        (["posefutures", "posefutures.bearer._w"], 401),
        (["posefutures", "posefutures.bearer.k"], 401),
        (["posefutures"], 401),
        ([], 401),
    ],
)
def test_browsers_give_their_key_as_a_protocol(bundles: Path, protocols: list[str], status: int):
    with Service.of(bundles, api_keys=KEY) as running:
        running.wait_until_loaded()

        async def opened() -> dict[str, Any]:
            async with Stream(running.app, protocols=protocols) as stream:
                return stream.opening

        opening = running.run(opened())
    assert opening.get("status", 101) == status
    assert opening.get("subprotocol") == ("posefutures" if status == 101 else None)


def test_a_header_counts_before_a_protocol(strict: Service):
    async def opened() -> dict[str, Any]:
        async with Stream(strict.app, key="wrong", protocols=[key_protocol("k")]) as stream:
            return stream.opening

    assert strict.run(opened())["status"] == 401


def test_a_protocol_that_nobody_offers_is_not_taken(service: Service):
    async def opened() -> dict[str, Any]:
        async with Stream(service.app, protocols=["graphql-ws"]) as stream:
            return stream.opening

    opening = service.run(opened())
    assert (opening["type"], opening["subprotocol"]) == ("websocket.accept", None)


def test_answers_count_at_the_rate_of_the_caller(strict: Service):
    async def streamed() -> dict[str, Any]:
        async with Stream(strict.app, key="k") as stream:
            stream.start(**OPTIONS)
            for i in range(14, 17):
                first = 0 if i == 14 else i
                stream.push(WALK[first : i + 1], TIMES[first : i + 1])
                while (message := await stream.said())["type"] not in ("futures", "error"):
                    pass
                if i < 16:
                    assert message["t"] == TIMES[i]
            return message["problem"]

    problem = strict.run(streamed())
    assert problem["type"] == "/problems/rate-limited"
    assert problem["retry_after_s"] > 0.0


def test_streams_end_when_the_server_drains(bundles: Path):
    with Service.of(bundles) as service:
        service.wait_until_loaded()

        async def drained() -> list[dict[str, Any]]:
            async with Stream(service.app) as stream:
                stream.start(**OPTIONS)
                assert (await stream.said())["type"] == "ready"
                await drain(service.app)
                stream.push(WALK[:1], TIMES[:1])
                told = [await stream.said(), await stream.said()]
            async with Stream(service.app) as late:
                return [*told, late.opening]

        error, close, late = service.run(drained())
        assert error["problem"]["type"] == "/problems/unavailable"
        assert close == {"type": "close", "code": 1012}
        assert late["status"] == 503


def test_real_connections_are_closed_when_the_server_ends(bundles: Path):
    with ExitStack() as server:
        live = server.enter_context(Live(bundles))
        with connect(f"ws://127.0.0.1:{live.port}/stream") as socket:
            socket.send(orjson.dumps({"type": "start"}).decode())
            assert orjson.loads(socket.recv())["type"] == "ready"
            server.close()
            with pytest.raises(ConnectionClosed) as closed:
                socket.recv()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1012


def test_real_strangers_get_a_problem(bundles: Path):
    with Live(bundles, api_keys="k") as live:
        url = f"ws://127.0.0.1:{live.port}/stream"
        with pytest.raises(InvalidStatus) as refused:
            connect(url)
        assert refused.value.response.status_code == 401
        assert orjson.loads(refused.value.response.body)["type"] == "/problems/unauthorised"
        browsers = [Subprotocol("posefutures"), Subprotocol(key_protocol("k"))]
        with connect(url, subprotocols=browsers) as socket:
            assert socket.subprotocol == "posefutures"
        with connect(url, additional_headers={"authorization": "Bearer k"}) as socket:
            socket.send(orjson.dumps({"type": "start"}).decode())
            assert orjson.loads(socket.recv())["type"] == "ready"


def test_a_stream_is_one_line_of_the_log(service: Service, caplog: pytest.LogCaptureFixture):
    async def streamed() -> None:
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            stream.push(WALK[:15], TIMES[:15])
            await stream.said_of("futures")
            stream.say(type="?")
            await stream.said()

    with caplog.at_level("INFO", logger="service.http.visits"):
        service.run(streamed())
    (facts,) = [record.facts for record in caplog.records if hasattr(record, "facts")]
    assert (facts["route"], facts["status"], facts["outcome"]) == ("/stream", 101, "ok")
    assert (facts["model"], facts["frames"], facts["problems"]) == ("diffusion", 15, 1)
    assert facts["answers"] >= 1


def test_it_loads_before_it_answers(bundles: Path):
    with Service.of(bundles) as service:
        service.app.state.catalog.entries["diffusion"].state = "loading"

        async def streamed() -> dict[str, Any]:
            async with Stream(service.app) as stream:
                stream.start(**OPTIONS)
                return (await stream.said())["problem"]

        told = service.run(streamed())
        service.wait_until_loaded()
    assert told["status"] == 503


def test_asyncio_is_left_without_tasks(service: Service):
    async def streamed() -> int:
        before = len(asyncio.all_tasks())
        async with Stream(service.app) as stream:
            stream.start(**OPTIONS)
            stream.push(WALK, TIMES)
            await stream.said_of("futures")
        return len(asyncio.all_tasks()) - before

    assert service.run(streamed()) == 0
