"""Viewers of answers; that of Rerun where it is installed, which is large."""

import socket
from pathlib import Path

import httpx
import numpy as np
import pytest
from in_memory import Service
from tiny_bundles import walking

from models.motion.skeleton import BODY21
from service.asking.messages import ActionsPrediction, Prediction
from service.client import Client
from service.show.bones import bones, future_rgb, parents_of

WALK = walking()


@pytest.fixture(scope="module")
def prediction(service: Service) -> Prediction:
    return Client(transport=service).predict(WALK, num_samples=3, seed=1)


@pytest.fixture(scope="module")
def performed(performing_service: Service) -> ActionsPrediction:
    client = Client(transport=performing_service)
    return client.predict_actions(WALK, ["reach"], num_samples=3, seed=1)


def test_bones_join_parents_and_joints():
    lines = bones(WALK, BODY21.parents)
    assert lines.shape == (15, 20, 2, 3)
    knee = BODY21.index("left_lower_leg")
    np.testing.assert_array_equal(lines[4, knee - 1, 1], WALK[4, knee])
    np.testing.assert_array_equal(lines[4, knee - 1, 0], WALK[4, BODY21.parents[knee]])


def test_parents_are_those_given_or_of_a_standard_skeleton():
    assert parents_of(BODY21.joints, None) == BODY21.parents
    assert parents_of(["a", "b"], [-1, 0]) == [-1, 0]
    with pytest.raises(ValueError, match="parents: found none for 2 joints"):
        parents_of(["a", "b"], None)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # viser's own, of websockets
def test_viser_shows_the_frame_of_its_slider(prediction: Prediction, performed: ActionsPrediction):
    viser = pytest.importorskip("viser")
    from service.show.viser import show

    for answer in (prediction, performed):
        server = viser.ViserServer(host="127.0.0.1", port=free_port(), verbose=False)
        try:
            assert show(answer, observed=WALK, server=server) is server
            page = httpx.get(f"http://127.0.0.1:{server.get_port()}")
            assert "<html" in page.text
            (slider,) = server.gui._gui_input_handle_from_uuid.values()
            drawn = server.scene._handle_from_node_name
            first = drawn["/futures/0"].points.copy()
            np.testing.assert_allclose(
                first, bones(answer.futures[0][0], BODY21.parents), atol=1e-5
            )
            assert "/observed" in drawn
            slider.value = slider.max
            for i, future in enumerate(answer.futures):
                expected = bones(future[-1], BODY21.parents)
                np.testing.assert_allclose(drawn[f"/futures/{i}"].points, expected, atol=1e-5)
        finally:
            server.stop()


def test_rerun_records_what_was_seen_and_the_futures(prediction: Prediction, tmp_path: Path):
    pytest.importorskip("rerun")
    from service.show.rerun import show

    file = tmp_path / "futures.rrd"
    show(prediction, observed=WALK, file=file).disconnect()
    content = file.read_bytes()
    assert content.startswith(b"RRF2")
    for path in ("/observed", "/futures/0", "/futures/2"):
        assert path.encode() in content
    assert len({future_rgb(i) for i in range(3)}) == 3
