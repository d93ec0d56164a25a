"""``return: ["occupancy"]`` over HTTP: in anybody's axes, in every type of content, or refused."""

from typing import Any

import numpy as np
import orjson
import pytest
from in_memory import JSON, Service, dumped
from tiny_bundles import FPS, walking

from models.motion.skeleton import BODY21
from service.client import Client
from service.media import DOCUMENTS, decoded

WALK = walking()
HAND = BODY21.index("left_hand")
BALL = {"capsule": {"start": [0.1, 0.3, 0.9], "end": [0.1, 0.3, 0.9], "radius": 0.05}}
BOX = {"box": {"center": [0.6, 0.1, 0.5], "size": [0.4, 0.3, 1.0], "yaw": 0.3}}
ASKED = {"poses": WALK, "num_samples": 20, "seed": 4, "return": ["futures", "occupancy"]}


def answer(service: Service, path: str = "/predict", **fields: Any) -> dict[str, Any]:
    response = service.post(ASKED | fields, path)
    assert response.status_code == 200, response.text
    content: dict[str, Any] = orjson.loads(response.content)
    return content


def in_box(points: np.ndarray, box: dict[str, Any]) -> np.ndarray:
    """Whether points are in a box, by its definition."""
    cos, sin = np.cos(box["yaw"]), np.sin(box["yaw"])
    x, y, z = np.moveaxis(points - box["center"], -1, 0)
    own = np.stack([cos * x + sin * y, -sin * x + cos * y, z], axis=-1)
    return (np.abs(own) <= np.array(box["size"]) / 2).all(axis=-1)


def test_what_is_told_is_what_the_futures_do(service: Service):
    """Many points of each bone, one by one."""
    content = answer(service, occupancy={"regions": [BOX]})
    futures = np.array(content["futures"])
    parents = [max(parent, 0) for parent in BODY21.parents]
    within = np.zeros(futures.shape[:2], dtype=bool)
    for share in np.linspace(0.0, 1.0, 200):
        points = futures + share * (futures[:, :, parents] - futures)
        within |= in_box(points, BOX["box"]).any(axis=-1)
    (region,) = content["occupancy"]
    assert 0.05 < within.any(axis=1).mean() < 1.0
    assert np.abs(region["probability"] - within.mean(axis=0)).max() <= 1 / 20 + 1e-6
    assert np.abs(region["probability"] - within.mean(axis=0)).mean() < 0.01
    assert set(region["num_lasting"]) == {20}
    first = np.where(within.any(axis=1), (within.argmax(axis=1) + 1) / FPS, np.inf)
    assert abs(region["first_entry"]["never"] - np.isinf(first).mean()) <= 1 / 20 + 1e-6
    levels, times = region["first_entry"]["levels"], region["first_entry"]["time_s"]
    for level, time_s in zip(levels, times, strict=True):
        share = np.mean(first <= (np.inf if time_s is None else time_s + 1 / FPS))
        assert share >= level - 1e-6
    assert region["min_distance"]["distance"] == sorted(region["min_distance"]["distance"])


def test_a_margin_is_metres_and_a_distance_the_units_of_the_caller(service: Service):
    """The same person and robot, in centimetres with y up, tell the same."""
    z_up = answer(service, occupancy={"regions": [BOX, BALL], "margin_m": 0.1})

    def turned(points: Any) -> Any:
        x, y, z = np.moveaxis(100.0 * np.array(points), -1, 0)
        return np.stack([y, z, x], axis=-1).tolist()

    box = BOX["box"]
    regions = [
        {"box": {"center": turned(box["center"]), "size": turned(box["size"]), "yaw": 0.3}},
        {"capsule": {"start": turned(BALL["capsule"]["start"]),
                     "end": turned(BALL["capsule"]["end"]), "radius": 5.0}},
    ]  # fmt: skip
    y_up = answer(
        service,
        poses=np.array(turned(WALK)),
        axes={"up": "y", "units": "cm"},
        occupancy={"regions": regions, "margin_m": 0.1},
    )
    np.testing.assert_allclose(y_up["futures"], turned(z_up["futures"]), atol=0.05)
    for ours, theirs in zip(z_up["occupancy"], y_up["occupancy"], strict=True):
        np.testing.assert_allclose(ours["probability"], theirs["probability"], atol=0.051)
        np.testing.assert_allclose(
            100.0 * np.array(ours["min_distance"]["distance"]),
            theirs["min_distance"]["distance"],
            atol=0.05,
        )


def test_a_region_about_the_person_is_entered_at_once_and_one_far_away_never(service: Service):
    here = {"box": {"center": [0.0, 0.0, 1.0], "size": [9.0, 9.0, 9.0]}}
    there = {"box": {"center": [99.0, 0.0, 1.0], "size": [1.0, 1.0, 1.0]}}
    near, far = answer(service, occupancy={"regions": [here, there]})["occupancy"]
    assert set(near["probability"]) == {1.0}
    assert near["first_entry"]["never"] == 0.0
    np.testing.assert_allclose(near["first_entry"]["time_s"], 1 / FPS, atol=1e-4)
    assert near["min_distance"]["distance"] == [0.0] * 3
    assert set(far["probability"]) == {0.0}
    assert far["first_entry"] == {
        "never": 1.0, "levels": [0.05, 0.5, 0.95], "time_s": [None] * 3
    }  # fmt: skip
    assert min(far["min_distance"]["distance"]) > 90.0


def test_points_of_the_scene_are_not_the_person(service: Service):
    """A file's root that stays where it is does not enter the region that it is in."""
    poses = np.concatenate([np.full((len(WALK), 1, 3), 7.0), WALK], axis=1)
    names = ["Scene", *BODY21.joints]
    parents = [-1, 0, *(parent + 1 for parent in BODY21.parents[1:])]
    region = {"box": {"center": [7.0, 7.0, 7.0], "size": [0.5, 0.5, 0.5]}}
    content = answer(
        service,
        poses=poses,
        skeleton={"joints": names, "parents": parents},
        occupancy={"regions": [region]},
    )
    assert content["occupancy"][0]["first_entry"]["never"] == 1.0


def test_futures_of_actions_count_while_they_last(performing_service: Service):
    fields = {"actions": ["reach"], "occupancy": {"regions": [BOX], "margin_m": 0.2}}
    content = answer(performing_service, "/predict_actions", **fields)
    lengths = np.array([future["num_frames"] for future in content["futures"]])
    (region,) = content["occupancy"]
    assert len(set(lengths)) > 1
    assert region["num_lasting"] == [int((lengths > i).sum()) for i in range(lengths.max())]
    assert len(region["probability"]) == lengths.max()
    alone = answer(performing_service, "/predict_actions", **fields, **{"return": ["occupancy"]})
    assert "futures" not in alone
    assert alone["occupancy"] == content["occupancy"]


@pytest.mark.parametrize("path", ["/predict", "/predict_actions"])
def test_every_type_of_content_tells_the_same(performing_service: Service, path: str):
    body = ASKED | {"occupancy": {"regions": [BOX], "margin_m": 0.1}, "return": ["occupancy"]}
    body |= {"actions": ["reach"]} if path == "/predict_actions" else {}
    told = {}
    for media_type in DOCUMENTS:
        response = performing_service.request(
            "POST", path, content=dumped(body), headers=JSON | {"accept": media_type}
        )
        content = decoded(response.content, media_type, limit=2**24)
        told[media_type] = content
    json, msgpack, npz = (told[media_type] for media_type in DOCUMENTS)
    (expected,), (packed,) = json["occupancy"], msgpack["occupancy"]
    np.testing.assert_allclose(npz["occupancy/0/probability"], expected["probability"], atol=1e-6)
    for name in ("num_lasting", "first_entry", "min_distance"):
        assert npz["occupancy"][0][name] == packed[name] == expected[name]
    np.testing.assert_allclose(packed["probability"], expected["probability"], atol=1e-6)


def test_client_gives_arrays_and_takes_them(service: Service):
    regions = [{"box": {"center": np.array([9.0, 0.0, 1.0]), "size": (1.0, 1.0, 1.0)}}, BOX]
    with Client(transport=service) as client:
        prediction = client.predict(
            WALK, num_samples=8, returned=["occupancy"], occupancy={"regions": regions}
        )
    far, near = prediction.occupancy
    assert far.never == 1.0
    assert np.isinf(far.first_entry_s).all()
    assert near.probability.shape == near.num_lasting.shape == (60,)
    assert (far.min_distance > 5.0).all()


BAD: dict[str, tuple[dict[str, Any], str, str]] = {
    "no regions": (
        {"return": ["occupancy"]}, "/occupancy", "required where return names occupancy"
    ),
    "regions that nobody asks for": (
        {"return": ["futures"], "occupancy": {"regions": [BOX]}}, "/return", "must name occupancy"
    ),
    "none": ({"occupancy": {"regions": []}}, "/occupancy/regions", "at least 1 item"),
    "too many": ({"occupancy": {"regions": [BOX] * 17}}, "/occupancy/regions", "at most 16 items"),
    "an empty one": (
        {"occupancy": {"regions": [BOX, {}]}}, "/occupancy/regions/1", "must be {\"box\": ...} or"
    ),
    "both in one": (
        {"occupancy": {"regions": [BOX | BALL]}}, "/occupancy/regions/0", "must be {\"box\": ...}"
    ),
    "a flat centre": (
        {"occupancy": {"regions": [{"box": BOX["box"] | {"center": [1.0, 2.0]}}]}},
        "/occupancy/regions/0/box/center", "at least 3 items",
    ),
    "a negative size": (
        {"occupancy": {"regions": [{"box": BOX["box"] | {"size": [1.0, -2.0, 1.0]}}]}},
        "/occupancy/regions/0/box/size/1", "greater than or equal to 0",
    ),
    "an absurd place": (
        {"occupancy": {"regions": [{"box": BOX["box"] | {"center": [1e300, 0.0, 0.0]}}]}},
        "/occupancy/regions/0/box/center/0", "less than or equal to 10000000",
    ),
    "a radius that is text": (
        {"occupancy": {"regions": [{"capsule": BALL["capsule"] | {"radius": "thin"}}]}},
        "/occupancy/regions/0/capsule/radius", "valid number",
    ),
    "a negative margin": (
        {"occupancy": {"regions": [BOX], "margin_m": -1}}, "/occupancy/margin_m",
        "greater than or equal to 0",
    ),
    "a level of one": (
        {"occupancy": {"regions": [BOX], "levels": [1.0]}}, "/occupancy/levels/0", "less than 1",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_regions_are_problems(service: Service, case: str):
    fields, pointer, expected = BAD[case]
    response = service.post(ASKED | fields)
    problem = orjson.loads(response.content)
    assert response.status_code == 422
    assert problem["pointer"] == pointer
    assert expected in problem["expected"]


def test_numbers_that_are_none_are_problems(service: Service):
    body = dumped(ASKED | {"occupancy": {"regions": [BOX]}}).replace(b'"yaw":0.3', b'"yaw":NaN')
    response = service.post(body)
    assert response.status_code == 422
    assert orjson.loads(response.content)["pointer"] == "/occupancy/regions/0/box/yaw"
