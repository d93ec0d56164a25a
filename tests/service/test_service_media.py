import contextlib
import io
import json
import zipfile
from typing import Any

import httpx
import msgpack
import numpy as np
import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st
from in_memory import JSON, Service, dumped
from tiny_bundles import walking

from service.errors import BodyTooLargeError, MalformedBodyError, NotAcceptableError
from service.media import DOCUMENTS, MSGPACK, NPZ, STREAMS, accepted, decoded, encoded

WALK = walking()
FIELDS = {"seed": 5, "num_samples": 3}
LIMIT = 2**24


def packed(content: dict[str, Any]) -> bytes:
    return encoded(content, MSGPACK)


def zipped(**arrays: Any) -> bytes:
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def posted(
    service: Service,
    content: bytes,
    media_type: str,
    *,
    accept: str = "*/*",
    path: str = "/predict",
) -> httpx.Response:
    headers = {"content-type": media_type, "accept": accept, "x-request-id": "me"}
    return service.request("POST", path, content=content, headers=headers)


# fmt: off
ACCEPTED = [
    ("", "application/json"),
    ("*/*", "application/json"),
    ("application/*", "application/json"),
    ("text/*", "text/event-stream"),
    ("application/x-msgpack", "application/msgpack"),
    ("Application/X-NPZ;q=0.9, application/json;q=0.5", "application/x-npz"),
    ("application/json;q=0, */*;q=0.1", "application/msgpack"),
    ("text/html, application/xhtml+xml, */*;q=0.8", "application/json"),
    ("application/x-ndjson", "application/x-ndjson"),
]
# fmt: on


@pytest.mark.parametrize(("header", "expected"), ACCEPTED)
def test_preferred_media_type_is_chosen(header: str, expected: str):
    assert accepted(header, (*DOCUMENTS, *STREAMS)) == expected


@given(st.text(max_size=60))
def test_any_accept_header_is_met_or_refused(header: str):
    try:
        assert accepted(header, DOCUMENTS) in DOCUMENTS
    except NotAcceptableError:
        assert header.strip()


@pytest.mark.parametrize("accept", ["text/html", "application/json;q=0", "image/png, audio/*"])
def test_what_no_path_answers_in_is_refused(service: Service, accept: str):
    response = posted(service, dumped({"poses": WALK}), "application/json", accept=accept)
    assert (response.status_code, response.json()["type"]) == (406, "/problems/not-acceptable")
    assert "application/x-npz" in response.json()["expected"]


def test_every_media_type_says_the_same(service: Service):
    ways = {
        "application/json": dumped({"poses": WALK} | FIELDS),
        "application/msgpack": packed({"poses": WALK} | FIELDS),
        "application/x-npz": zipped(poses=WALK, **FIELDS),
    }
    plain = orjson.loads(posted(service, ways["application/json"], "application/json").content)
    expected = np.array(plain.pop("futures"))
    for sent, body in ways.items():
        for wanted in DOCUMENTS:
            response = posted(service, body, sent, accept=wanted)
            assert response.headers["content-type"] == wanted
            if wanted == NPZ:
                with np.load(io.BytesIO(response.content)) as archive:
                    futures, content = archive["futures"], json.loads(str(archive["meta"]))
                    assert content.pop("futures") is None
            else:
                content = decoded(response.content, wanted, limit=LIMIT)
                futures = np.array(content.pop("futures"))
            assert content | {"timing_ms": None} == plain | {"timing_ms": None}
            np.testing.assert_array_equal(futures.astype(np.float32), expected.astype(np.float32))


def test_msgpack_array_is_what_the_documents_say(service: Service):
    response = posted(service, packed({"poses": WALK} | FIELDS), MSGPACK, accept=MSGPACK)
    array = msgpack.unpackb(response.content)["futures"]
    assert set(array) == {"shape", "dtype", "data"}
    assert (array["shape"], array["dtype"]) == ([3, 60, 21, 3], "float32")
    assert len(array["data"]) == 4 * 3 * 60 * 21 * 3
    futures = np.frombuffer(array["data"], "<f4").reshape(array["shape"])
    assert np.abs(futures[:, 0] - WALK[-1]).max() < 0.2


def test_actions_come_as_arrays_of_their_own_lengths(performing_service: Service):
    fields = {"actions": ["reach", "wave"], "num_samples": 3, "seed": 5}
    body = packed({"poses": WALK} | fields)
    path = "/predict_actions"
    plain = orjson.loads(posted(performing_service, body, MSGPACK, path=path).content)
    response = posted(performing_service, body, MSGPACK, accept=NPZ, path=path)
    with np.load(io.BytesIO(response.content)) as archive:
        meta = json.loads(str(archive["meta"]))
        for i, future in enumerate(plain["futures"]):
            np.testing.assert_allclose(archive[f"futures/{i}/poses"], future["poses"], atol=1e-6)
            assert meta["futures"][i] == future | {"poses": None}


@pytest.mark.parametrize("dtype", ["float16", "float32", "float64"])
def test_joint_of_three_nan_was_not_seen(service: Service, dtype: str):
    poses = WALK.copy()
    poses[3:5, 8] = np.nan
    answer = orjson.loads(posted(service, packed({"poses": poses.astype(dtype)}), MSGPACK).content)
    assert "left_hand is null in 2 of the last 15 frames" in answer["warnings"][0]


# fmt: off
WRONG_POSES = [
    (WALK[0], "/poses", "an array of shape (21, 3)"),
    (WALK[:, :20], "/poses", "an array of shape (15, 20, 3)"),
    (np.full((15, 21, 3), np.inf), "/poses/0/0/0", "infinity"),
    (np.where(np.arange(945).reshape(WALK.shape) == 259, np.nan, WALK), "/poses/4/2/1", "NaN"),
]
# fmt: on


@pytest.mark.parametrize(("poses", "pointer", "found"), WRONG_POSES)
def test_array_at_fault_is_named(service: Service, poses: np.ndarray, pointer: str, found: str):
    problem = posted(service, packed({"poses": poses}), MSGPACK).json()
    assert (problem["status"], problem["type"]) == (422, "/problems/invalid-poses")
    assert (problem["pointer"], problem["found"]) == (pointer, found)


def test_field_of_another_kind_is_named(service: Service):
    for value in (b"raw", WALK, {"a": b"b"}):
        problem = posted(service, packed({"poses": WALK, "seed": value}), MSGPACK).json()
        assert (problem["status"], problem["pointer"]) == (422, "/seed")


# fmt: off
MALFORMED = [
    (MSGPACK, b""), (MSGPACK, b"\xc1"), (MSGPACK, packed({"a": 1})[:-1]), (MSGPACK, b"\x91" * 5000),
    (MSGPACK, msgpack.packb([1, 2])), (MSGPACK, msgpack.packb({1: 2})),
    (MSGPACK, msgpack.packb({"poses": {"shape": [3], "dtype": "object", "data": b"12345678"}})),
    (MSGPACK, msgpack.packb({"poses": {"shape": [3, -5], "dtype": "float32", "data": b"1234"}})),
    (MSGPACK, msgpack.packb({"poses": {"shape": "x", "dtype": "float32", "data": b"1234"}})),
    (MSGPACK, msgpack.packb({"poses": {"shape": [3], "dtype": "float32", "data": "text"}})),
    (NPZ, b""), (NPZ, b"PK\x03\x04"), (NPZ, zipped(poses=WALK)[:-30]),
    (NPZ, zipped(poses=np.array([{}], dtype=object))),
    (NPZ, zipped(poses=WALK, meta=np.array("[1]"))), (NPZ, zipped(poses=WALK, meta=np.array("{"))),
    (NPZ, zipped(poses=WALK, meta=np.array(7))),
]
# fmt: on


@pytest.mark.parametrize(("media_type", "body"), MALFORMED)
def test_body_that_is_not_what_it_says_is_refused(service: Service, media_type: str, body: bytes):
    response = posted(service, body, media_type)
    assert (response.status_code, response.json()["type"]) == (400, "/problems/malformed-body")


def test_npz_may_not_grow_beyond_the_limit_when_it_is_unpacked(service: Service):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("poses.npy", bytes(2**25))
    response = posted(service, file.getvalue(), NPZ)
    assert (response.status_code, response.json()["type"]) == (413, "/problems/body-too-large")


def test_array_that_claims_more_than_there_is_costs_no_memory(service: Service):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": (2**40, 21, 3)}
    )
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("poses.npy", header.getvalue())
    assert posted(service, file.getvalue(), NPZ).status_code == 400


@given(st.binary(max_size=200), st.sampled_from(DOCUMENTS))
def test_any_bytes_are_read_or_refused(body: bytes, media_type: str):
    with contextlib.suppress(MalformedBodyError, BodyTooLargeError):
        assert isinstance(decoded(body, media_type, limit=LIMIT), dict)


_SCALARS = st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.text(max_size=5)


@given(st.dictionaries(st.text(max_size=5), st.lists(_SCALARS) | _SCALARS, max_size=5))
def test_content_survives_its_way(content: dict[str, Any]):
    assert decoded(packed(content), MSGPACK, limit=LIMIT) == content


def test_big_body_is_the_same_person(service: Service):
    long = walking(700)
    options = {"seed": 2, "num_samples": 2}
    short = service.futures(long[-60:], **options)
    np.testing.assert_array_equal(service.futures(long, **options), short)
    assert len(dumped({"poses": long})) > 2**16
    assert JSON
