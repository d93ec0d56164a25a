import socket
from pathlib import Path

import httpx
import orjson
import pytest
from in_memory import JSON, Service, dumped
from live import PATIENCE_S, Live, until
from pydantic import ValidationError
from tiny_bundles import walking

from service.errors import OverloadedError
from service.http.problems import problem
from service.settings import Settings

BODY = dumped({"poses": walking(), "num_samples": 1})


def posted(service: Service, **headers: str) -> httpx.Response:
    return service.request("POST", "/predict", content=BODY, headers=JSON | headers)


def test_full_queue_says_when_to_come_again(bundles: Path):
    settings = {"max_samples": 1000, "max_poses": 10**6, "rows_per_step": 1, "workers": 1}
    with Live(bundles, max_queued_requests=1, **settings) as live:
        huge = dumped({"poses": walking(), "num_samples": 1000})
        with live.sock(huge):
            until(lambda: live.under_way() == 1)
            for accept in ("application/json", "text/event-stream"):
                headers = JSON | {"accept": accept}
                response = httpx.post(f"{live.url}/predict", content=BODY, headers=headers)
                content = response.json()
                assert (response.status_code, content["type"]) == (429, "/problems/overloaded")
                assert content["retry_after_s"] > 0
                retry = int(response.headers["retry-after"])
                assert content["retry_after_s"] <= retry <= max(1, content["retry_after_s"] + 1)
            with socket.create_connection(("127.0.0.1", live.port), timeout=PATIENCE_S) as head:
                head.sendall(b"POST /predict HTTP/1.1\r\nhost: x\r\ncontent-length: 999\r\n\r\n")
                assert head.recv(12) == b"HTTP/1.1 429"  # its body was not waited for
        until(lambda: live.under_way() == 0)
        assert httpx.post(f"{live.url}/predict", content=BODY, headers=JSON).status_code == 200
        assert 'motion_rejected_total{reason="overloaded"} 3.0' in httpx.get(
            f"{live.url}/metrics"
        ).text  # fmt: skip


@pytest.mark.parametrize(("seconds", "whole"), [(0.02, "1"), (1.0, "1"), (1.01, "2"), (7.4, "8")])
def test_whole_seconds_are_rounded_up_and_the_exact_ones_told(seconds: float, whole: str):
    response = problem(OverloadedError("the queue: full.", retry_after_s=seconds))
    assert response.headers["retry-after"] == whole
    assert orjson.loads(response.body)["retry_after_s"] == seconds


def test_without_keys_everybody_may_ask(service: Service):
    assert posted(service).status_code == 200
    assert posted(service, authorization="Bearer whatever").status_code == 200
    assert "security" not in service.get("/openapi.json").json()


def test_key_is_needed_for_all_but_health(bundles: Path):
    with Service.of(bundles, api_keys=("first", "second")) as service:
        service.wait_until_loaded()
        assert service.get("/livez").status_code == service.get("/readyz").status_code == 200
        for path in ("/models", "/metrics", "/limits", "/docs", "/nowhere"):
            response = service.get(path)
            assert (response.status_code, response.json()["type"]) == (
                401,
                "/problems/unauthorised",
            )
            assert response.headers["www-authenticate"] == "Bearer"
            assert response.headers["x-request-id"]
        wrong = ("", "Bearer", "Bearer ", "Bearer third", "Bearer first second", "Basic first",
                 "first")  # fmt: skip
        for header in wrong:
            assert posted(service, authorization=header).status_code == 401
        for header in ("Bearer first", "bearer  second"):
            assert posted(service, authorization=header).status_code == 200
        key = {"authorization": "Bearer first"}
        document = service.request("GET", "/openapi.json", headers=key).json()
        assert document["security"] == [{"key": []}]


def test_keys_come_from_the_environment_and_are_not_shown(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("POSEFUTURES_API_KEYS", "hush, quiet,")
    settings = Settings()
    assert [key.get_secret_value() for key in settings.api_keys] == ["hush", "quiet"]
    assert "hush" not in repr(settings)


def test_each_key_has_its_own_rate(bundles: Path):
    with Service.of(bundles, api_keys=("a", "b"), rate_limit="2/hour") as service:
        service.wait_until_loaded()
        answers = [posted(service, authorization=f"Bearer {key}") for key in "aabaab"]
        assert [answer.status_code for answer in answers] == [200, 200, 200, 429, 429, 200]
        refused = answers[3]
        assert refused.json()["type"] == "/problems/rate-limited"
        assert 0 < refused.json()["retry_after_s"] <= 3600
        assert 0 < int(refused.headers["retry-after"]) <= 3600
        key = {"authorization": "Bearer a"}
        assert service.request("GET", "/models", headers=key).status_code == 200
        assert service.request("GET", "/limits", headers=key).json()["rate_limit"] == "2/hour"


def test_without_keys_each_address_has_its_rate(bundles: Path):
    with Service.of(bundles, rate_limit="1/hour") as service:
        service.wait_until_loaded()
        assert [posted(service).status_code for _ in range(2)] == [200, 429]


def test_rate_that_is_none_is_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("POSEFUTURES_RATE_LIMIT", "often")
    with pytest.raises(ValidationError, match="rate_limit"):
        Settings()
