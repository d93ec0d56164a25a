from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from in_memory import JSON, Service, dumped
from tiny_bundles import walking

from service.errors import ServiceError

WALK = walking().tolist()


def replaced(frame: int, joint: int | None, value: Any) -> list[Any]:
    poses = walking().tolist()
    if joint is None:
        poses[frame] = value
    else:
        poses[frame][joint] = value
    return poses


def fields(**options: Any) -> dict[str, Any]:
    return {"poses": WALK, "num_samples": 1, **options}


def scaled(factor: float) -> np.ndarray:
    return walking() * factor


# fmt: off
CASES = [
    ("invalid-field", "", {}, "nothing"),
    ("invalid-field", "/poses", {"poses": "here"}, '"here"'),
    ("invalid-field", "/pose", fields(pose=1), "a field that is not known"),
    ("invalid-field", "/num_samples", fields(num_samples=0), "0"),
    ("invalid-field", "/num_samples", fields(num_samples=201), "201"),
    ("invalid-field", "/num_samples", fields(num_samples="5"), '"5"'),
    ("invalid-field", "/num_samples", fields(num_samples=2.5), "2.5"),
    ("invalid-field", "/num_samples", fields(num_samples=True), "true"),
    ("invalid-field", "/num_steps", fields(num_steps=0), "0"),
    ("invalid-field", "/num_steps", fields(num_steps=11), "11"),
    ("invalid-field", "/seed", fields(seed=-1), "-1"),
    ("invalid-field", "/seed", fields(seed=2**53), str(2**53)),
    ("invalid-field", "/fps", fields(fps=0), "0"),
    ("invalid-field", "/fps", fields(fps=1e9), "1000000000.0"),
    ("invalid-field", "/bone_lengths", fields(bone_lengths="rubber"), '"rubber"'),
    ("invalid-field", "/axes/up", fields(axes={"up": "north"}), '"north"'),
    ("invalid-field", "/axes/left", fields(axes={"left": "y"}), "a field that is not known"),
    ("invalid-field", "/skeleton", fields(skeleton=5), "5"),
    ("invalid-field", "/skeleton/joints", fields(skeleton={"map": {}}), "nothing"),
    ("invalid-field", "/skeleton/joints/3",
     fields(skeleton={"joints": ["a", "b", "c", 4, "e", "f", "g", "h"]}), "4"),
    ("invalid-poses", "/poses/2", fields(poses=replaced(2, None, 7)), "7"),
    ("invalid-poses", "/poses/14", fields(poses=replaced(14, None, WALK[0][:20])), "20 joints"),
    ("invalid-poses", "/poses/0", fields(skeleton="smpl22"), "21 joints"),
    ("invalid-poses", "/poses/3/11", fields(poses=replaced(3, 11, [1.0, 2.0])), "a list of 2"),
    ("invalid-poses", "/poses/3/11", fields(poses=replaced(3, 11, "x")), '"x"'),
    ("invalid-poses", "/poses/3/11/1", fields(poses=replaced(3, 11, [1.0, None, 1.0])), "null"),
    ("invalid-poses", "/poses/3/11/2", fields(poses=replaced(3, 11, [1.0, 1.0, "2"])), '"2"'),
    ("invalid-poses", "/poses/3/11/0", fields(poses=replaced(3, 11, [True, 1.0, 1.0])), "true"),
    ("invalid-poses", "/poses/3/11", fields(poses=replaced(3, 11, [0, 1e9, 0])), "a joint 1e+09 m"),
    ("invalid-poses", "/poses/3/11", fields(poses=replaced(3, 11, [0, 50, 0])), "a joint 50 m"),
    ("invalid-poses", "/poses", fields(poses=[[None] * 21] * 15), "no joint"),
    ("invalid-poses", "/poses", fields(poses=[[[0, 0, 0]] * 21] * 15), "a body 0 m across"),
    ("invalid-poses", "/axes/units", fields(poses=scaled(1000)), "a body 1.64e+03 m across"),
    ("invalid-poses", "/axes/units", fields(poses=scaled(100)), "a body 164 m across"),
    ("invalid-field", "/deadline_ms", fields(deadline_ms=0), "0"),
    ("invalid-field", "/tolerance_m", fields(tolerance_m=-1), "-1"),
    ("invalid-field", "/horizon_s", fields(horizon_s=0), "0"),
    ("invalid-field", "/horizon_s", fields(horizon_s=10.5), "10.5 s"),
    ("invalid-field", "/num_samples", fields(num_samples=200, horizon_s=10, fps=300, poses=walking(
        150, fps=300.0)), "200 futures of up to 3000 frames"),
    ("invalid-field", "/return", fields(**{"return": []}), "a list of 0"),
    ("invalid-field", "/return/0", fields(**{"return": ["past"]}), '"past"'),
    ("invalid-field", "/num_modes", fields(num_modes=0), "0"),
    ("invalid-field", "/quantile_levels/1", fields(quantile_levels=[0.5, 1.0]), "1.0"),
    ("invalid-field", "/num_samples", fields(**{"return": ["quantiles"]}), "1"),
    ("too-few-frames", "/poses", fields(poses=WALK[:14]), "14 frames at 30 fps"),
    ("too-few-frames", "/poses", fields(poses=[]), "0 frames at 30 fps"),
    ("too-few-frames", "/poses", fields(fps=60), "15 frames at 60 fps"),
    ("unknown-skeleton", "/skeleton", fields(skeleton="octopus"), "'octopus'"),
    ("unknown-skeleton", "/skeleton", fields(skeleton={"joints": [f"j{i}" for i in range(21)]}),
     "21 joints that do not make a body"),
    ("unknown-model", "/model", fields(model="oracle"), "'oracle'"),
]
# fmt: on


@pytest.mark.parametrize(("slug", "pointer", "body", "found"), CASES)
def test_field_at_fault_is_named_with_what_was_found(
    service: Service, slug: str, pointer: str, body: dict[str, Any], found: str
):
    response = service.post(body)
    problem = response.json()
    assert response.headers["content-type"] == "application/problem+json"
    assert response.status_code == problem["status"] == 422
    assert problem["type"] == f"/problems/{slug}"
    if pointer:
        assert problem["pointer"] == pointer
    assert problem["found"].startswith(found)
    assert problem["expected"]
    assert problem["found"] in problem["detail"]
    assert problem["expected"] in problem["detail"]


@pytest.mark.parametrize(
    ("literal", "found"), [("NaN", "NaN"), ("Infinity", "infinity"), ("-Infinity", "infinity")]
)
def test_number_that_json_lacks_is_found_where_it_is(service: Service, literal: str, found: str):
    body = dumped(fields(poses=replaced(3, 11, [0.0, 12345.0, 0.0])))
    problem = service.post(body.replace(b"12345.0", literal.encode())).json()
    assert problem["status"] == 422
    assert (problem["pointer"], problem["found"]) == ("/poses/3/11/1", found)
    huge = service.post(body.replace(b"12345.0", b"9" * 400)).json()
    assert (huge["status"], huge["pointer"]) == (422, "/poses/3/11/1")
    overflowing = service.post(body.replace(b"12345.0", b"1e999")).json()
    assert (overflowing["status"], overflowing["found"]) == (422, "infinity")


def test_problem_says_how_many_frames_are_needed(service: Service):
    problem = service.post(fields(poses=WALK[:9], fps=25.0)).json()
    assert problem["expected"] == "diffusion needs 13 frames at this rate (0.50 s)"


def test_wrong_units_are_guessed(service: Service):
    for factor, name in ((1000.0, "millimetres"), (100.0, "centimetres")):
        assert f"looks like {name}" in service.post(fields(poses=scaled(factor))).json()["detail"]
    small = service.post(fields(poses=WALK, axes={"units": "mm"})).json()
    assert "looks like metres" in small["detail"]


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"poses", b"[1, 2]", b"null", b'"text"', b"\xff\xfe", b'{"poses": [1,]}',
     b"[" * 100_000, b'{"poses": NaN'],
)  # fmt: skip
def test_body_that_is_no_json_object_is_refused(service: Service, body: bytes):
    response = service.post(body)
    assert response.status_code == 400
    assert response.json()["type"] == "/problems/malformed-body"


@pytest.mark.parametrize("content_type", ["text/plain", "application/x-www-form-urlencoded", None])
def test_other_media_types_are_refused(service: Service, content_type: str | None):
    headers = {"content-type": content_type} if content_type else {}
    response = service.request("POST", "/predict", content=dumped(fields()), headers=headers)
    assert response.status_code == 415
    assert response.json()["type"] == "/problems/unsupported-media-type"
    good = {"content-type": "Application/JSON; charset=utf-8"}
    response = service.request("POST", "/predict", content=dumped(fields()), headers=good)
    assert response.status_code == 200


def test_body_too_large_is_refused_with_and_without_a_declared_length(bundles: Path):
    with Service.of(bundles, max_body_bytes=1000) as service:
        service.wait_until_loaded()
        body = dumped(fields())

        async def chunks():
            for start in range(0, len(body), 500):
                yield body[start : start + 500]

        for content in (body, chunks()):
            response = service.request("POST", "/predict", content=content, headers=JSON)
            assert response.status_code == 413
            assert response.json()["type"] == "/problems/body-too-large"
            assert "at most 1000" in response.json()["detail"]


def test_server_may_take_fewer_frames_and_samples(bundles: Path):
    with Service.of(bundles, max_frames=20, max_samples=5) as service:
        service.wait_until_loaded()
        assert service.post(fields(num_samples=6)).json()["pointer"] == "/num_samples"
        assert service.post(fields(poses=walking(21))).json()["pointer"] == "/poses"
        assert service.post(fields(poses=walking(20), num_samples=5)).status_code == 200


def test_path_and_method_are_checked(service: Service):
    missing = service.get("/predictions")
    assert (missing.status_code, missing.json()["type"]) == (404, "/problems/not-found")
    method = service.get("/predict")
    assert (method.status_code, method.json()["type"]) == (405, "/problems/method-not-allowed")
    assert method.headers["allow"] == "POST"
    model = service.get("/models/oracle")
    assert (model.status_code, model.json()["type"]) == (404, "/problems/unknown-model")


def test_nan_of_a_graph_never_leaves_and_the_server_goes_on(service: Service):
    flying = {"poses": walking(speed=99.0), "num_samples": 2}
    good = fields(seed=1, num_steps=5)
    alone = orjson.loads(service.post(good).content)["futures"]
    responses = service.post_together([good, flying, good])
    assert [response.status_code for response in responses] == [200, 500, 200]
    assert responses[1].json()["type"] == "/problems/prediction-failed"
    assert "gave NaN" in responses[1].json()["detail"]
    assert orjson.loads(responses[2].content)["futures"] == alone


def test_every_problem_of_the_tree_is_reached_by_these_tests():
    def family(error: type[ServiceError]) -> set[str]:
        return {error.slug}.union(*(family(child) for child in error.__subclasses__()))

    reached = {slug for slug, *_ in CASES} | {
        "malformed-body", "unsupported-media-type", "body-too-large", "not-found",
        "method-not-allowed", "prediction-failed",
        "unavailable",  # test_service_catalog
        "unsuitable-model", "unknown-action",  # test_service_actions
        "deadline-too-short",  # test_service_http
        "not-acceptable",  # test_service_media
        "unreadable-file",  # test_service_files
        "overloaded", "rate-limited", "unauthorised",  # test_service_overload
        "cancelled", "unknown-request",  # test_service_delivery
    }  # fmt: skip
    abstract = {"internal", "bad-request"}
    assert family(ServiceError) - abstract == reached
