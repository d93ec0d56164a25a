import io
import zipfile
from pathlib import Path
from time import perf_counter
from typing import Any

import httpx
import numpy as np
import orjson
import pygltflib
import pytest
from in_memory import JSON, Service, dumped
from tiny_bundles import walking

from models.motion.axes import Axes
from models.motion.formats.bvh import read_bvh
from models.motion.skeleton import BODY21
from service.answers.answer import Answer
from service.media import BVH, GLB
from service.worker import Worker

WALK = walking()
OPTIONS = {"seed": 3, "num_samples": 1}


def asked(service: Service, accept: str, path: str = "/predict", **fields: Any) -> httpx.Response:
    content = dumped({"poses": WALK} | OPTIONS | fields)
    return service.request("POST", path, content=content, headers=JSON | {"accept": accept})


def motion(folder: Path, content: bytes) -> np.ndarray:
    path = folder / "future.bvh"
    path.write_bytes(content)
    read = read_bvh(path, scale=0.01)
    return read.positions[:, [read.skeleton.index(joint) for joint in BODY21.joints]]


@pytest.mark.parametrize("lengths", ["observed", "free"])
def test_one_future_is_a_bvh_of_the_same_positions(service: Service, tmp_path: Path, lengths: str):
    response = asked(service, BVH, bone_lengths=lengths)
    assert response.headers["content-type"] == BVH
    assert response.headers["content-disposition"] == 'attachment; filename="future-0.bvh"'
    expected = service.futures(WALK, bone_lengths=lengths, **OPTIONS)[0]
    found = motion(tmp_path, response.content)
    assert np.linalg.norm(found - expected, axis=-1).max() < 1e-3
    inner = response.text.count("CHANNELS 6") - 1
    assert inner == 0 if lengths == "observed" else inner > 0


def test_way_out_of_an_answer_begins_when_its_files_are_made(
    service: Service, monkeypatch: pytest.MonkeyPatch
):
    made_s: list[float] = []
    since_made_s: list[tuple[float, float]] = []
    files = Answer.files

    def timed(answer: Answer) -> tuple[bytes, dict[str, str]]:
        made = files(answer)
        made_s.append(perf_counter())
        return made

    def sent(_: Worker, seconds: float) -> None:
        since_made_s.append((seconds, perf_counter() - made_s[0]))

    monkeypatch.setattr(Answer, "files", timed)
    monkeypatch.setattr(Worker, "sent", sent)
    assert asked(service, BVH).status_code == 200
    [(seconds, since_s)] = since_made_s
    assert seconds <= since_s


def test_file_is_upright_and_in_metres_whatever_the_caller_uses(service: Service, tmp_path: Path):
    axes = {"up": "-y", "units": "mm"}
    poses = Axes(up="-y", units="mm").from_metres(WALK)
    found = motion(tmp_path, asked(service, BVH, poses=poses.tolist(), axes=axes).content)
    expected = motion(tmp_path, asked(service, BVH).content)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_several_futures_are_a_zip_with_what_else_the_answer_says(service: Service, tmp_path: Path):
    response = asked(service, f"{BVH}, */*;q=0.1", num_samples=11)
    assert response.headers["content-type"] == "application/zip"
    expected = service.futures(WALK, seed=3, num_samples=11)
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        names = [f"future-{i:02d}.bvh" for i in range(11)]
        assert archive.namelist() == [*names, "answer.json"]
        about = orjson.loads(archive.read("answer.json"))
        for name, future in zip(names, expected, strict=True):
            found = motion(tmp_path, archive.read(name))
            assert np.linalg.norm(found - future, axis=-1).max() < 1e-3
        heads = {archive.read(name).split(b"MOTION")[0].count(b"OFFSET") for name in names}
        assert min(heads) >= 21
    assert (about["seed"], about["num_frames"]) == (3, 60)
    assert "futures" not in about


def test_future_is_an_animated_glb(service: Service):
    response = asked(service, GLB)
    assert response.headers["content-type"] == GLB
    document = pygltflib.GLTF2().load_from_bytes(response.content)
    names = [node.name for node in document.nodes]
    assert set(BODY21.joints) <= set(names)
    assert len(document.animations[0].channels) > 21


def test_actions_are_files_of_their_own_lengths(performing_service: Service, tmp_path: Path):
    fields = {"actions": ["reach", "wave"], "num_samples": 3}
    path = "/predict_actions"
    plain = orjson.loads(asked(performing_service, "*/*", path, **fields).content)["futures"]
    response = asked(performing_service, BVH, path, **fields)
    with zipfile.ZipFile(io.BytesIO(response.content)) as archive:
        for i, future in enumerate(plain):
            found = motion(tmp_path, archive.read(f"future-{i}.bvh"))
            assert len(found) == future["num_frames"]
            assert np.linalg.norm(found - np.array(future["poses"]), axis=-1).max() < 1e-3


def test_file_without_futures_is_refused(service: Service):
    problem = asked(service, BVH, **{"return": ["modes"]}).json()
    assert (problem["status"], problem["pointer"]) == (422, "/return")
