from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import orjson
import pytest
from in_memory import JSON, Service, dumped, untimed
from live import Live, until
from tiny_bundles import walking

WALK = walking()
SSE, NDJSON = "text/event-stream", "application/x-ndjson"
HUGE = dumped({"poses": WALK, "num_samples": 1000, "seed": 1})
SLOW = {"max_samples": 1000, "max_poses": 10**6, "rows_per_step": 1, "workers": 1}


def asked(**fields: Any) -> bytes:
    return dumped({"poses": WALK, "seed": 4, "num_samples": 3, **fields})


def streamed(
    service: Service, body: bytes, accept: str, *, path: str = "/predict"
) -> httpx.Response:
    headers = JSON | {"accept": accept, "x-request-id": "me"}
    return service.request("POST", path, content=body, headers=headers)


def events(response: httpx.Response) -> list[tuple[str, bytes]]:
    """Names and data of the events of a stream, as its standard says to read them."""
    if response.headers["content-type"].startswith(SSE):
        parts = response.content.removesuffix(b"\n\n").split(b"\n\n")
        lines = [dict(line.split(b": ", 1) for line in part.split(b"\n")) for part in parts]
        return [(line[b"event"].decode(), line[b"data"]) for line in lines]
    lines = response.content.removesuffix(b"\n").split(b"\n")
    objects = [orjson.loads(line) for line in lines]
    assert all(set(found) == {"event", "data"} for found in objects)
    return [
        (found["event"], line[line.index(b'"data":') + 7 : -1])
        for found, line in zip(objects, lines, strict=True)
    ]


@pytest.fixture(scope="module")
def live(bundles: Path) -> Iterator[Live]:
    with Live(bundles, **SLOW) as running:
        yield running


@pytest.mark.parametrize("accept", [SSE, NDJSON])
@pytest.mark.parametrize("num_steps", [None, 4])
def test_stream_ends_with_the_plain_answer(service: Service, accept: str, num_steps: int | None):
    body = asked(num_steps=num_steps)
    response = streamed(service, body, accept)
    assert response.status_code == 200
    assert response.headers["content-type"].split(";")[0] == accept
    found = events(response)
    names = [name for name, _ in found]
    assert names[0] == "accepted"
    assert names[-2:] == ["final", "end"]
    assert set(names[1:-2]) == {"preview"}
    plain = streamed(service, body, "application/json").content
    assert untimed(dict(found)["final"]) == untimed(plain)


def test_stream_tells_what_was_accepted_and_shows_each_step(service: Service):
    found = events(streamed(service, asked(), NDJSON))
    accepted, *previews = (orjson.loads(data) for name, data in found
                           if name in ("accepted", "preview"))  # fmt: skip
    final = orjson.loads(dict(found)["final"])
    assert accepted == {"id": "me", "model": final["model"], "seed": 4, "steps": {"of": 10}}
    assert [preview["steps"]["run"] for preview in previews] == list(range(1, 10))
    for preview in previews:
        early = orjson.loads(
            streamed(service, asked(num_steps=preview["steps"]["run"]), "application/json").content
        )
        assert preview["futures"] == early["futures"]
    assert set(final["timing_ms"]) == {"queue", "engine", "answer"}


PERFORMED = "/predict_actions"


@pytest.mark.parametrize("accept", [SSE, NDJSON])
@pytest.mark.parametrize("actions", [["wave"], ["reach", "wave", "crouch"]])
@pytest.mark.parametrize("fps", [30.0, 25.0])
def test_stream_of_actions_grows_to_the_plain_answer(
    performing_service: Service, accept: str, actions: list[str], fps: float
):
    body = asked(actions=actions, fps=fps, num_samples=5)
    response = streamed(performing_service, body, accept, path=PERFORMED)
    assert response.headers["content-type"].split(";")[0] == accept
    found = events(response)
    names = [name for name, _ in found]
    assert names[0] == "accepted"
    assert names[-2:] == ["final", "end"]
    assert set(names[1:-2]) == {"preview"}
    plain = streamed(performing_service, body, "application/json", path=PERFORMED).content
    assert untimed(dict(found)["final"]) == untimed(plain)
    accepted, *previews = (orjson.loads(data) for _, data in found[:-2])
    final, most = orjson.loads(plain), 8 * len(actions)
    assert accepted == {"id": "me", "model": final["model"], "seed": 4, "steps": {"of": most}}
    runs = [preview["steps"]["run"] for preview in previews]
    assert runs == sorted(set(runs))
    assert runs[-1] < most
    for preview in previews:
        assert (preview["id"], preview["steps"]["of"]) == ("me", most)
        for now, then in zip(preview["futures"], final["futures"], strict=True):
            assert now["num_frames"] == len(now["poses"]) == now["segments"][-1]["end"]
            *ended, last = now["segments"]
            assert ended == then["segments"][: len(ended)]
            assert last["action"] == actions[len(ended)]
            if last["stopped"]:
                assert last == then["segments"][len(ended)]
            if fps == 30.0:  # at another rate the last frame aims beyond what is there
                same = min(last["end"], then["segments"][len(ended)]["end"])
                assert now["poses"][:same] == then["poses"][:same]


def test_actions_at_fault_get_a_problem_and_no_stream(performing_service: Service):
    response = streamed(performing_service, asked(actions=["fly"]), SSE, path=PERFORMED)
    assert (response.status_code, response.json()["pointer"]) == (422, "/actions/0")
    assert response.headers["content-type"] == "application/problem+json"


def test_stream_of_actions_that_fails_ends_in_an_error(performing_service: Service):
    body = dumped({"poses": walking(speed=99.0), "actions": ["wave", "reach"], "num_samples": 2})
    found = events(streamed(performing_service, body, NDJSON, path=PERFORMED))
    assert [name for name, _ in found] == ["accepted", "error"]
    assert orjson.loads(found[-1][1])["type"] == "/problems/prediction-failed"


def test_stream_of_actions_that_breaks_off_looks_like_none_that_is_whole(
    bundles_with_actions: Path,
):
    body = dumped({"poses": WALK, "actions": ["wave", "reach"] * 8, "num_samples": 1000})
    with Live(bundles_with_actions, **SLOW) as live:
        with live.sock(body, path=PERFORMED, accept=NDJSON) as connection:
            until(lambda: live.under_way() == 1)
            assert httpx.delete(f"{live.url}/requests/mine").status_code == 204
            until(lambda: live.under_way() == 0)
            answer = b""
            while b"/problems/cancelled" not in answer:
                answer += connection.recv(2**16) or pytest.fail(repr(answer))
            assert b'"final"' not in answer
            assert b'{"event":"end"' not in answer
        connection = live.sock(body, path=PERFORMED, accept=SSE)
        until(lambda: live.under_way() == 1)
        connection.close()
        until(lambda: live.under_way() == 0)
        until(lambda: live.app.state.streams == set())


def test_drawn_seed_is_told_before_the_first_preview(service: Service):
    body = dumped({"poses": WALK, "num_samples": 1})
    found = dict(events(streamed(service, body, NDJSON)))
    assert orjson.loads(found["accepted"])["seed"] == orjson.loads(found["final"])["seed"]


def test_request_at_fault_gets_a_problem_and_no_stream(service: Service):
    response = streamed(service, asked(num_steps=11), SSE)
    assert (response.status_code, response.json()["pointer"]) == (422, "/num_steps")
    assert response.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize("accept", [SSE, NDJSON])
def test_stream_that_fails_ends_in_an_error_and_not_in_an_end(service: Service, accept: str):
    body = dumped({"poses": walking(speed=99.0), "num_samples": 2})
    found = events(streamed(service, body, accept))
    assert [name for name, _ in found] == ["accepted", "error"]
    problem = orjson.loads(found[-1][1])
    assert (problem["status"], problem["type"]) == (500, "/problems/prediction-failed")


def test_client_that_leaves_frees_its_rows(live: Live):
    for accept in ("application/json", SSE):
        connection = live.sock(HUGE, accept=accept)
        until(lambda: live.under_way() == 1)
        connection.close()
        until(lambda: live.under_way() == 0)
    text = httpx.get(f"{live.url}/metrics").text
    assert 'motion_requests_total{endpoint="/predict",outcome="cancelled"} 2.0' in text
    assert live.app.state.streams == set()
    assert httpx.post(f"{live.url}/predict", content=asked(), headers=JSON).status_code == 200


@pytest.mark.parametrize("accept", ["application/json", NDJSON])
def test_request_can_be_cancelled_by_its_id(live: Live, accept: str):
    with live.sock(HUGE, accept=accept) as connection:
        until(lambda: live.under_way() == 1)
        assert httpx.delete(f"{live.url}/requests/mine").status_code == 204
        until(lambda: live.under_way() == 0)
        answer = b""
        while b"/problems/cancelled" not in answer:
            answer += connection.recv(2**16) or pytest.fail(repr(answer))
        assert (b"409" in answer.split(b"\r\n")[0]) == (accept != NDJSON)
        assert b'"end"' not in answer
    again = httpx.delete(f"{live.url}/v1/requests/mine")
    assert (again.status_code, again.json()["type"]) == (404, "/problems/unknown-request")


def test_server_answers_while_it_computes(live: Live):
    with live.sock(HUGE):
        until(lambda: live.under_way() == 1)
        for path in ("/livez", "/readyz", "/models", "/limits", "/metrics"):
            assert httpx.get(f"{live.url}{path}").status_code == 200
        assert live.under_way() == 1


def test_streams_are_limited_and_their_places_are_freed(bundles: Path):
    with Live(bundles, max_streams=1, **SLOW) as live:
        for _ in range(2):
            with live.sock(HUGE, accept=SSE):
                until(lambda: live.under_way() == 1)
                headers = JSON | {"accept": SSE}
                response = httpx.post(f"{live.url}/predict", content=asked(), headers=headers)
                assert response.status_code == 429
                assert response.json()["type"] == "/problems/overloaded"
            until(lambda: live.app.state.streams == set())
