from typing import Any

import numpy as np
import orjson
import pytest
from in_memory import Service
from tiny_bundles import walking

from models.motion.axes import Axes
from models.motion.joint_tables import REQUIRED
from models.motion.skeleton import BODY21, SENT_ORDERS, SKELETONS, joint_map
from models.motion.standards import STANDARDS

WALK = walking(30)
PATH = "/skeletons/validate"


def validated(service: Service, poses: Any, **fields: Any) -> dict[str, Any]:
    response = service.post(
        {"poses": poses.tolist() if isinstance(poses, np.ndarray) else poses, **fields}, PATH
    )
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = orjson.loads(response.content)
    return answer


def sentences(answer: dict[str, Any]) -> dict[str, str]:
    return {found["about"]: found["sentence"] for found in answer["findings"]}


def test_person_who_walks_is_understood_and_nothing_is_odd(service: Service):
    answer = validated(service, WALK)
    assert answer["findings"] == answer["warnings"] == []
    assert answer["predicts"]
    assert answer["map"] == {joint: joint for joint in BODY21.joints}
    assert answer["estimated"] == {}
    assert answer["guessed"] == []
    assert answer["axes"] == answer["looks_like"] == {"up": "z", "units": "m", "handed": "right"}
    assert set(answer["joint_sources"]) == {"observed"}


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_standard_skeleton_is_recognised_in_its_own_axes(service: Service, name: str):
    weights, _ = joint_map(BODY21, SKELETONS[name])
    sent = np.empty((30, len(weights), 3))
    sent[:, list(SENT_ORDERS[name])] = np.einsum("ij,tjk->tik", weights, WALK)
    usual = STANDARDS[name].axes
    answer = validated(service, usual.from_metres(sent), skeleton=name)
    assert answer["predicts"], answer["problem"]
    assert answer["joints"] == list(STANDARDS[name].joints)
    assert answer["axes"] == answer["looks_like"]
    assert sentences(answer) == {}
    legs = {own for own, body21 in answer["map"].items() if body21.endswith("_foot")}
    assert len(legs) == 2
    assert set(answer["guessed"]) <= {"left_toes", "right_toes"}


@pytest.mark.parametrize("units", ["cm", "mm"])
@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "-z"])
def test_other_axes_and_units_are_guessed(service: Service, up: Any, units: Any):
    answer = validated(service, Axes(up=up, units=units).from_metres(WALK))
    assert answer["looks_like"] == {"up": up, "units": units, "handed": "right"}
    said = sentences(answer)
    assert set(said) == {"units", "up"}
    assert f"they look like '{units}'" in said["units"]
    assert f"along '{up}', not along 'z'" in said["up"]
    assert not answer["predicts"]
    assert answer["problem"]["pointer"] == "/axes/units"


ODD = {
    "up": (Axes(up="y").from_metres(WALK), "axes.up: the shoulders are over the feet along 'y', "),
    "units": (0.3 * WALK, "axes.units: a leg is 0.2"),
    "sides": (
        WALK[:, list(BODY21.mirror)].copy(),
        "poses: the toes point backwards: left and right ",
    ),
}


@pytest.mark.parametrize("about", ODD)
def test_prediction_warns_of_how_the_body_stands_as_the_dry_run_does(service: Service, about: str):
    poses, warning = ODD[about]
    answer = service.post({"poses": poses, "num_samples": 1}).json()
    (said,) = answer["warnings"]
    assert said.startswith(warning)
    dry = validated(service, poses)
    assert dry["warnings"] == answer["warnings"]
    sentence = said.partition(": ")[2]
    assert sentences(dry) == {about: sentence[0].upper() + sentence[1:]}


def test_swapped_sides_are_said(service: Service):
    swapped = WALK[:, list(BODY21.mirror)]
    assert "left and right look swapped" in sentences(validated(service, swapped))["sides"]
    mirrored = WALK * np.array([1.0, -1.0, 1.0])
    assert "toes point backwards" in sentences(validated(service, mirrored))["sides"]
    lower = ("leg", "foot", "toes")
    legs = [
        BODY21.mirror[i] if joint.endswith(lower) else i for i, joint in enumerate(BODY21.joints)
    ]
    said = sentences(validated(service, WALK[:, legs]))
    assert "side of the right arm" in said["sides"]


def test_left_handed_axes_undo_a_mirror(service: Service):
    mirrored = WALK * np.array([1.0, -1.0, 1.0])
    assert validated(service, mirrored, axes={"handed": "left"})["findings"] == []


def test_frozen_frames_are_counted(service: Service):
    hanging = WALK.copy()
    hanging[10:14] = hanging[9]
    said = sentences(validated(service, hanging))["frozen"]
    assert "4 of 29 frames" in said
    assert "frame 10:" in said
    still = np.repeat(WALK[:1], 30, axis=0)
    assert sentences(validated(service, still)) == {
        "frozen": "The person does not move at all in any frame."
    }


def test_limbs_that_change_their_length_are_said(service: Service):
    noisy = WALK.copy()
    elbow, hand = BODY21.index("left_lower_arm"), BODY21.index("left_hand")
    stretch = np.linspace(0.7, 1.3, 30)[:, None]
    noisy[:, hand] = noisy[:, elbow] + (noisy[:, hand] - noisy[:, elbow]) * stretch
    said = sentences(validated(service, noisy))
    assert set(said) == {"limbs"}
    assert "1 of 8 limbs" in said["limbs"]
    assert "left_hand, by 18 %" in said["limbs"]


def test_jump_to_another_place_is_said(service: Service):
    jumping = WALK.copy()
    jumping[20:, :, 1] += 0.9
    said = sentences(validated(service, jumping))
    assert set(said) == {"teleport"}
    assert "Between frames 19 and 20 the body moves by 0.90 m" in said["teleport"]


def test_missing_path_is_said(service: Service):
    legs = [BODY21.index(f"{side}_upper_leg") for side in ("left", "right")]
    rooted = WALK - WALK[:, legs].mean(axis=1, keepdims=True)
    said = sentences(validated(service, rooted))
    assert "futures stay in place too" in said["path"]


def test_joints_never_seen_are_named(service: Service):
    poses = WALK.tolist()
    for frame in poses:
        frame[BODY21.index("hips")] = frame[BODY21.index("left_hand")] = None
    answer = validated(service, poses)
    assert answer["predicts"]
    given = dict(zip(answer["joints"], answer["joint_sources"], strict=True))
    assert (given["hips"], given["left_hand"]) == ("derived", "imputed")
    found = [found["sentence"] for found in answer["findings"]]
    assert any("derived from others: hips." in sentence for sentence in found)
    assert any("guessed: left_hand." in sentence for sentence in found)


@pytest.mark.parametrize("lost", [it for it in BODY21.joints if it not in REQUIRED])
def test_any_joint_but_those_of_legs_and_shoulders_may_never_be_seen(service: Service, lost: str):
    poses = WALK.tolist()
    for pose in poses:
        pose[BODY21.index(lost)] = None
    sources = validated(service, poses)["joint_sources"]
    assert [source == "observed" for source in sources] == [it != lost for it in BODY21.joints]


def test_too_short_is_told_and_the_rest_is_too(service: Service):
    answer = validated(service, WALK[:10])
    assert not answer["predicts"]
    assert answer["problem"]["type"] == "/problems/too-few-frames"
    assert answer["findings"] == []


@pytest.mark.parametrize(
    ("fields", "pointer"),
    [
        ({"poses": []}, "/poses"),
        ({"poses": [[None] * 21] * 20}, "/poses"),
        ({"poses": WALK[:, :20].tolist()}, "/poses/0"),
        ({"poses": WALK, "skeleton": "octopus"}, "/skeleton"),
        ({"poses": WALK, "model": "octopus"}, "/model"),
        ({"poses": WALK, "num_samples": 3}, "/num_samples"),
        (
            {"poses": WALK[:, :8].tolist(), "skeleton": {"joints": [f"j{i}" for i in range(8)]}},
            "/skeleton",
        ),
    ],
)
def test_what_cannot_be_understood_is_an_error(service: Service, fields: Any, pointer: str):
    response = service.post(fields, PATH)
    assert (response.status_code, response.json()["pointer"]) == (422, pointer), response.text
