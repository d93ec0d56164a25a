import httpx
import numpy as np
import pytest
from in_memory import Service
from tiny_bundles import walking

from service.client import BadRequestError, Client, ConnectionFailedError, ServerFailedError


def test_client_gives_arrays(service: Service):
    with Client(transport=service) as client:
        poses = walking()
        poses[4, 8] = np.nan
        prediction = client.predict(poses, skeleton="body21", fps=30.0, num_samples=3, seed=5)
        assert prediction.futures.shape == (3, 60, 21, 3)
        assert (prediction.seed, prediction.fps, prediction.model) == (5, 30.0, "diffusion")
        assert prediction.joints[0] == "hips"
        assert "left_hand is null" in prediction.warnings[0]
        assert client.models()["default"] == "diffusion"


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


def test_client_raises_what_the_server_says(service: Service):
    client = Client(transport=service)
    with pytest.raises(BadRequestError, match="found 'octopus'") as caught:
        client.predict(walking(), skeleton="octopus")
    assert (caught.value.status, caught.value.slug) == (422, "unknown-skeleton")
    assert caught.value.problem["pointer"] == "/skeleton"
    with pytest.raises(ServerFailedError, match="gave NaN"):
        client.predict(walking(speed=99.0))


def test_client_says_that_nobody_answers():
    with (
        Client("http://127.0.0.1:1", timeout_s=1.0) as client,
        pytest.raises(ConnectionFailedError, match="found no server that answers"),
    ):
        client.models()


def test_client_survives_an_answer_that_is_not_ours():
    transport = httpx.MockTransport(lambda _: httpx.Response(502, text="<html>bad gateway</html>"))
    with pytest.raises(ServerFailedError, match="HTTP 502"):
        Client(transport=transport).predict(walking())
