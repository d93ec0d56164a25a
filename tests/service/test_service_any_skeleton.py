"""People as trackers send them: any skeleton, axes and times, with holes and noise."""

from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from in_memory import Service
from tiny_bundles import walking

from models.bundle import Manifest, read_manifest
from models.motion.axes import Axes
from models.motion.skeleton import BODY21, SENT_ORDERS, SKELETONS, joint_map
from models.motion.standards import STANDARDS
from service.observation import Observation, read_observation
from service.schemas import AxesBody

WALK = walking(20)
METRES = {"up": "z", "units": "m", "handed": "right"}
OPTIONS = {"seed": 4, "num_samples": 3}
MEDIAPIPE = STANDARDS["mediapipe33"]
AXES = [
    Axes(up=up, units=units, handed=handed)
    for up, units in (("x", "m"), ("-x", "cm"), ("y", "cm"), ("-y", "mm"), ("z", "m"), ("-z", "m"))
    for handed in ("right", "left")
]


def in_skeleton(name: str, poses: np.ndarray = WALK) -> np.ndarray:
    """Poses in a standard skeleton, metres, +Z up, its joints as they are sent."""
    weights, _ = joint_map(BODY21, SKELETONS[name])
    sent = np.empty((len(poses), len(weights), 3))
    sent[:, list(SENT_ORDERS[name])] = np.einsum("ij,tjk->tik", weights, poses)
    return sent


def said(axes: Axes) -> dict[str, str]:
    return AxesBody(up=axes.up, units=axes.units, handed=axes.handed).model_dump()


def listed(poses: np.ndarray) -> list[Any]:
    return [[None if np.isnan(joint[0]) else joint.tolist() for joint in pose] for pose in poses]


def answered(service: Service, poses: np.ndarray, **fields: Any) -> dict[str, Any]:
    response = service.post({"poses": listed(poses)} | OPTIONS | fields)
    assert response.status_code == 200, response.text
    answer: dict[str, Any] = orjson.loads(response.content)
    return answer


@pytest.mark.parametrize("name", sorted(SKELETONS))
def test_usual_axes_of_a_skeleton_change_nothing_but_the_axes(service: Service, name: str):
    poses, usual = in_skeleton(name), STANDARDS[name].axes
    plain = np.array(answered(service, poses, skeleton=name, axes=METRES)["futures"])
    answer = answered(service, usual.from_metres(poses), skeleton=name)
    np.testing.assert_allclose(usual.to_metres(np.array(answer["futures"])), plain, atol=2e-4)
    assert answer["joints"] == list(STANDARDS[name].joints)


@pytest.mark.parametrize("axes", AXES, ids=lambda a: f"{a.up},{a.units},{a.handed}")
def test_any_axes_change_nothing_but_the_axes(service: Service, axes: Axes):
    plain = np.array(answered(service, WALK)["futures"])
    there = answered(service, axes.from_metres(WALK), axes=said(axes))["futures"]
    np.testing.assert_allclose(axes.to_metres(np.array(there)), plain, atol=2e-4)


@pytest.mark.parametrize("axes", AXES, ids=lambda a: f"{a.up},{a.units},{a.handed}")
def test_axes_mirror_only_what_is_left_handed(axes: Axes):
    unit = axes.to_metres(np.eye(3)) * {"m": 1, "cm": 100, "mm": 1000}[axes.units]
    assert np.linalg.det(unit) == pytest.approx(1.0 if axes.handed == "right" else -1.0)
    np.testing.assert_allclose(axes.from_metres(axes.to_metres(WALK)), WALK, atol=1e-9)


def test_skeletons_are_listed_as_they_are_sent(service: Service):
    listing = {s["name"]: s for s in service.get("/skeletons").json()["skeletons"]}
    assert set(listing) == set(STANDARDS)
    assert listing["kinect25"]["joints"][20] == "SpineShoulder"
    assert listing["kinect25"]["parents"][2] == 20
    assert listing["azure32"]["axes"] == {"up": "-y", "units": "mm", "handed": "right"}


def test_every_joint_tells_where_it_comes_from(service: Service):
    poses = WALK.copy()
    poses[:, BODY21.index("hips")] = np.nan
    poses[:, BODY21.index("left_hand")] = np.nan
    poses[-12:, BODY21.index("right_hand")] = np.nan
    poses[-4:, BODY21.index("head")] = np.nan
    answer = answered(service, poses)
    sources = dict(zip(answer["joints"], answer["joint_sources"], strict=True))
    assert sources.pop("hips") == "derived"
    assert sources.pop("left_hand") == "imputed"
    assert sources.pop("right_hand") == "imputed"
    assert set(sources.values()) == {"observed"}
    assert np.isfinite(np.array(answer["futures"], dtype=float)).all()


@pytest.fixture(scope="module")
def manifest(bundles: Path) -> Manifest:
    return read_manifest(bundles / "still")


def read(manifest: Manifest, poses: np.ndarray, **options: Any) -> Observation:
    fields: dict[str, Any] = {"skeleton": BODY21, "axes": Axes(), "fps": 30.0} | options
    return read_observation(listed(poses), manifest=manifest, **fields)


def test_what_is_lost_is_carried_by_the_body(manifest: Manifest):
    poses = walking(20, speed=3.0)
    lost = poses.copy()
    lost[-6:, BODY21.index("left_hand")] = np.nan
    found = read(manifest, lost).caller
    hand = found.last_pose[BODY21.index("left_hand")] + found.offset
    assert np.linalg.norm(hand - poses[-1, BODY21.index("left_hand")]) < 0.08  # of 0.6 m walked


def glide(times: np.ndarray) -> np.ndarray:
    return WALK[-1] + times[:, None, None] * np.array([1.3, 0.4, 0.0])


def test_uneven_times_are_the_same_motion(manifest: Manifest):
    rng = np.random.default_rng(0)
    even = np.arange(-19, 1) / 30.0
    uneven = even + np.where(even < 0, rng.uniform(-0.012, 0.012, 20), 0.0)
    expected = read(manifest, glide(even)).positions
    found = read(manifest, glide(uneven), times=(uneven + 1e9).tolist(), fps=None)
    np.testing.assert_allclose(found.positions, expected, atol=1e-5)
    assert found.caller.fps == pytest.approx(30.0, rel=0.2)
    assert read(manifest, glide(uneven), times=uneven.tolist()).caller.fps == 30.0


def test_answer_has_the_rate_of_the_times(service: Service):
    times = np.arange(-19, 1) / 24.0
    answer = answered(service, glide(times), timestamps=times.tolist())
    assert answer["fps"] == pytest.approx(24.0)
    assert answer["num_frames"] == 48


def test_long_gap_between_frames_is_said(manifest: Manifest):
    times = np.delete(np.arange(-19, 1) / 30.0, slice(8, 17))
    found = read(manifest, glide(times), times=times.tolist())
    assert any("0.33 s lie between two frames" in warning for warning in found.warnings)
    expected = read(manifest, glide(np.arange(-19, 1) / 30.0)).positions
    np.testing.assert_allclose(found.positions, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("fields", "pointer"),
    [
        ({"timestamps": [0.0] * 20}, "/timestamps/1"),
        ({"timestamps": [0.0]}, "/timestamps"),
        ({"timestamps": ["x", *range(19)]}, "/timestamps/0"),
        ({"confidence": [[1.0] * 21] * 19}, "/confidence"),
        ({"confidence": [[1.0] * 20] * 20}, "/confidence/0"),
        ({"confidence": [[1.0] * 21] * 19 + [[1.0] * 20 + [1.5]]}, "/confidence/19/20"),
        ({"axes": {"handed": "both"}}, "/axes/handed"),
    ],
)
def test_field_at_fault_is_named(service: Service, fields: Any, pointer: str):
    problem = service.post({"poses": WALK} | fields).json()
    assert (problem["status"], problem["pointer"]) == (422, pointer)


def test_too_short_by_its_times_is_refused(service: Service):
    times = (np.arange(20) / 100.0).tolist()
    problem = service.post({"poses": WALK, "timestamps": times, "fps": 30}).json()
    assert problem["type"] == "/problems/too-few-frames"


def test_confidence_decides_what_counts(manifest: Manifest):
    hand, elbow = BODY21.index("left_hand"), BODY21.index("left_lower_arm")
    wild = WALK.copy()
    wild[10, hand] += 0.5
    confidence = np.full((20, 21), 1.0)
    sure = read(manifest, wild, confidence=confidence.tolist())
    plain = read(manifest, wild)
    np.testing.assert_allclose(sure.positions, plain.positions, atol=2e-2)
    confidence[10, hand] = 0.1
    doubted = read(manifest, wild, confidence=confidence.tolist())
    np.testing.assert_allclose(doubted.positions, read(manifest, WALK).positions, atol=5e-3)
    confidence[:, elbow] = 0.1
    never = read(manifest, WALK, confidence=confidence.tolist())
    assert never.caller.sources[elbow] == "imputed"
    assert any("left_lower_arm is below 0.3 in every frame" in w for w in never.warnings)
    expected = read(manifest, WALK).positions
    np.testing.assert_allclose(never.positions, expected, atol=3e-2)


def test_less_trusted_joints_are_smoother(manifest: Manifest):
    rng = np.random.default_rng(0)
    noisy = WALK + rng.normal(0.0, 0.02, WALK.shape)

    def roughness(confidence: float) -> float:
        worth = np.full((20, 21), confidence).tolist()
        positions = read(manifest, noisy, confidence=worth).positions
        return float(np.abs(np.diff(positions, n=2, axis=0)).mean())

    sure, likely, doubtful = map(roughness, (1.0, 0.7, 0.4))
    assert doubtful < 0.8 * likely < 0.8 * sure


def stream(seconds: float = 4.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, poses and visibility of a person who walks before a webcam, as MediaPipe sends them.

    About 20 frames a second, noise of a centimetre, hands that are lost now and then for up to a
    third of a second, and ankles that are doubtful.
    """
    rng = np.random.default_rng(1)
    times = np.cumsum(rng.uniform(0.035, 0.065, int(seconds * 20)))
    whole = walking(int(seconds * 120) + 1, fps=120.0)
    nearest = np.round((times - times[-1]) * 120).astype(int) + len(whole) - 1
    poses = in_skeleton("mediapipe33", whole[nearest]) + rng.normal(0, 0.01, (len(times), 33, 3))
    visibility = np.full(poses.shape[:2], 0.95)
    for hand in (15, 16):
        for start in rng.integers(5, len(times), 5):
            visibility[start : start + 6, hand] = 0.05
            poses[start : start + 6, hand] += rng.normal(0, 0.3, 3)
    visibility[:, [27, 28]] = 0.5
    return times, MEDIAPIPE.axes.from_metres(poses), visibility


@pytest.mark.parametrize("model", ["still", "diffusion"])
def test_stream_of_a_webcam_predicts_without_jumps(service: Service, model: str):
    times, poses, visibility = stream()
    last = None
    for end in range(len(times) - 20, len(times) + 1):
        part = slice(end - 20, end)
        answer = answered(
            service,
            poses[part],
            skeleton="mediapipe33",
            timestamps=times[part].tolist(),
            confidence=visibility[part].tolist(),
            fps=30,
            model=model,
            bone_lengths="free",  # a model of random numbers lets shins shrink to nothing
        )
        futures = MEDIAPIPE.axes.to_metres(np.array(answer["futures"]))
        assert np.isfinite(futures).all()
        seen = MEDIAPIPE.axes.to_metres(poses[end - 1])
        sure = visibility[end - 1] > 0.3
        # A future begins where the person is, to a few times the noise, and goes on evenly.
        assert np.linalg.norm(futures[:, 0] - seen, axis=-1)[:, sure].max() < 0.15
        assert np.linalg.norm(np.diff(futures, axis=1), axis=-1).max() < 0.15
        now = futures[0, 0, [15, 16]]
        if last is not None:  # hands that were lost are where the body carries them
            assert np.linalg.norm(now - last, axis=-1).max() < 0.25
        last = now
