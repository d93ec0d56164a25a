import io
import zipfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import orjson
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from in_memory import Service
from tiny_bundles import walking, walking_in_a_scene

from models.motion.formats.bvh import write_bvh
from models.motion.formats.npz import clip_of, write_archive
from models.motion.motion import Motion
from models.motion.skeleton import BODY21
from service.media import MSGPACK, decoded

SAMPLES = Path(__file__).parents[3] / "shared/data/samples"


def walk(num_frames: int = 60, fps: float = 30.0) -> Motion:
    poses = walking(num_frames, fps=fps)
    return Motion(name="walk", skeleton=BODY21, positions=poses, fps=fps)


def bvh(motion: Motion) -> bytes:
    file = io.StringIO()
    write_bvh(file, motion)
    return file.getvalue().encode()


def sent(service: Service, body: bytes, accept: str = "*/*", **query: Any) -> httpx.Response:
    query = {"name": "walk.bvh"} | query
    return service.request(
        "POST", "/observations", content=body, params=query, headers={"accept": accept}
    )


def test_file_comes_back_as_what_predict_takes(service: Service):
    answer = orjson.loads(sent(service, bvh(walk())).content)
    assert (answer["name"], answer["fps"], answer["start_s"]) == ("walk", 30.0, 0.0)
    assert answer["duration_s"] == pytest.approx(59 / 30)
    order = [answer["skeleton"]["joints"].index(joint) for joint in BODY21.joints]
    np.testing.assert_allclose(np.array(answer["poses"])[:, order], walking(60), atol=2e-4)
    request = {name: answer[name] for name in ("poses", "skeleton", "axes", "fps")}
    predicted = service.post(request | {"num_samples": 2, "seed": 1})
    assert predicted.status_code == 200, predicted.text
    assert orjson.loads(predicted.content)["joints"] == answer["skeleton"]["joints"]


def test_a_scene_s_root_is_joined_to_the_body_by_no_bone(service: Service):
    motion = walking_in_a_scene(60, name="walk")
    answer = orjson.loads(sent(service, bvh(motion)).content)
    joints, drawn = answer["skeleton"]["joints"], answer["parents"]
    assert [joint for joint, parent in zip(joints, drawn, strict=True) if parent < 0] == [
        "joint_Root",
        "hips",
    ]
    assert answer["skeleton"]["parents"][joints.index("hips")] == joints.index("joint_Root")


def test_part_of_a_fast_file_is_cut_and_slowed(service: Service):
    answer = orjson.loads(sent(service, bvh(walk(241, 120.0)), start_s=0.5, end_s=1.0).content)
    assert (answer["fps"], len(answer["poses"]), answer["start_s"]) == (60.0, 31, 0.5)
    hips = answer["skeleton"]["joints"].index("hips")
    expected = walking(241, fps=120.0)[60:121:2, 0]
    np.testing.assert_allclose(np.array(answer["poses"])[:, hips], expected, atol=2e-4)


def test_observation_comes_as_messagepack_too(service: Service):
    response = sent(service, bvh(walk()), accept=MSGPACK)
    answer = decoded(response.content, MSGPACK, limit=10**9)
    assert answer["poses"].shape == (60, len(answer["skeleton"]["joints"]), 3)


def test_archive_of_one_clip_is_a_file_too(service: Service, tmp_path: Path):
    write_archive(tmp_path / "walk.npz", [clip_of(walk())])
    answer = orjson.loads(
        sent(service, (tmp_path / "walk.npz").read_bytes(), name="walk.npz").content
    )
    np.testing.assert_allclose(answer["poses"], walking(60), atol=2e-4)


@pytest.mark.skipif(not SAMPLES.is_dir(), reason=f"no sample files in {SAMPLES}")
def test_amc_comes_in_a_zip_with_its_asf(service: Service):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name in ("03_01.amc", "03.asf"):
            archive.write(SAMPLES / name, f"folder/{name}")
    answer = orjson.loads(sent(service, file.getvalue(), name="walk.zip").content)
    assert (answer["name"], answer["fps"]) == ("03_01", 60.0)
    alone = sent(service, (SAMPLES / "03_01.amc").read_bytes(), name="03_01.amc")
    assert (alone.status_code, alone.json()["type"]) == (422, "/problems/unreadable-file")
    assert "03.asf must be there" in alone.json()["detail"]


def zipped(**files: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name.replace("_", "."), content)
    return file.getvalue()


# fmt: off
REFUSED = [
    ("walk.bvh", b"", "MOTION must follow"),
    ("walk.bvh", b"\xff\x00", "MOTION must follow"),
    ("walk.fbx", b"", "'.fbx'"),
    ("walk", b"", "must be one of"),
    ("", b"", "must be one of"),
    ("..", b"", "must be that of a file"),
    ("../../etc/walk.bvh", b"", "walk.bvh:0"),
    ("a\0.bvh", b"", "must be that of a file"),
    ("a" * 999 + ".bvh", b"", "must be that of a file"),
    ("walk.npz", b"PK\x03\x04", "whole .npz"),
    ("walk.zip", b"PK\x03\x04", "must be a zip"),
    ("walk.zip", zipped(), "0 motions"),
    ("walk.zip", zipped(a_bvh=b"", b_bvh=b""), "2 motions"),
]
# fmt: on


@pytest.mark.parametrize(("name", "body", "message"), REFUSED)
def test_what_is_no_motion_is_refused(service: Service, name: str, body: bytes, message: str):
    problem = sent(service, body, name=name)
    assert problem.status_code == 422, problem.text
    assert problem.json()["type"] == "/problems/unreadable-file"
    assert message in problem.json()["detail"]
    assert "unpacked" not in problem.text


def test_seconds_outside_the_file_are_refused(service: Service):
    for query in ({"start_s": 2.0}, {"start_s": 1.0, "end_s": 0.5}):
        problem = sent(service, bvh(walk()), **query).json()
        assert (problem["status"], problem["pointer"]) == (422, "/query/start_s")
    assert sent(service, b"", start_s="x").json()["pointer"] == "/query/start_s"


def test_packed_file_may_not_grow_beyond_the_limit(service: Service):
    for name in ("a.zip", "a.npz"):
        problem = sent(service, zipped(a_bvh=bytes(2**25)), name=name)
        assert (problem.status_code, problem.json()["type"]) == (413, "/problems/body-too-large")


@settings(max_examples=60)
@given(body=st.binary(max_size=300), suffix=st.sampled_from([".bvh", ".npz", ".zip", ".amc", ""]))
def test_any_bytes_are_read_or_refused(service: Service, body: bytes, suffix: str):
    assert sent(service, body, name=f"x{suffix}").status_code == 422
