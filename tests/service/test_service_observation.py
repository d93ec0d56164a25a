from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_bundles import standing_pose, walking

from models.bundle import Manifest, read_manifest
from models.motion.axes import Axes
from models.motion.skeleton import BODY21, H36M17, joint_map
from service.errors import InputError, PosesError, TooFewFramesError, UnknownSkeletonError
from service.futures import caller_futures
from service.observation import Observation, frames_needed, read_observation
from service.poses.skeletons import OwnJoints

SAME_BUNDLE = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def manifest(bundles: Path) -> Manifest:
    return read_manifest(bundles / "still")


def read(manifest: Manifest, poses: Any, **options: Any) -> Observation:
    fields: dict[str, Any] = {"skeleton": BODY21, "axes": Axes(), "fps": 30.0} | options
    return read_observation(poses, manifest=manifest, **fields)


def test_poses_pass_unchanged_but_for_the_place(manifest: Manifest):
    poses = walking() + np.array([7.0, -3.0, 0.0])
    observation = read(manifest, poses.tolist())
    np.testing.assert_allclose(observation.caller.offset, [7.0, -3.0, 0.0])
    expected = (poses - observation.caller.offset).astype(np.float32)
    np.testing.assert_allclose(observation.positions, expected, atol=1e-6)
    np.testing.assert_array_equal(observation.caller.last_pose, poses[-1] - [7.0, -3.0, 0.0])


@pytest.mark.parametrize("fps", [10.0, 20.0, 25.0, 50.0, 60.0, 100.0, 120.0, 239.76])
def test_every_rate_gives_the_same_observation(manifest: Manifest, fps: float):
    # A body that moves evenly, so that no interpolation can be blamed.
    def gliding(num_frames: int, rate: float) -> np.ndarray:
        times = np.arange(1 - num_frames, 1)[:, None, None] / rate
        return standing_pose() + times * np.array([1.3, 0.4, 0.0])

    num_frames = frames_needed(manifest, fps)
    expected = read(manifest, gliding(15, 30.0).tolist()).positions
    positions = read(manifest, gliding(num_frames, fps).tolist(), fps=fps).positions
    np.testing.assert_allclose(positions, expected, atol=1e-5)
    with pytest.raises(TooFewFramesError, match=f"needs {num_frames} frames"):
        read(manifest, gliding(num_frames - 1, fps).tolist(), fps=fps)


def test_other_skeletons_are_mapped_and_guesses_are_said(manifest: Manifest):
    weights, _ = joint_map(BODY21, H36M17)
    poses = np.einsum("ij,tjk->tik", weights, walking())
    observation = read(manifest, poses.tolist(), skeleton=H36M17)
    assert any("left_toes" in warning for warning in observation.warnings)
    knee = BODY21.index("left_lower_leg")
    np.testing.assert_allclose(
        observation.positions[:, knee], walking()[:, knee].astype(np.float32), atol=1e-2
    )


def test_custom_tree_has_parents_first_and_follows_the_body(manifest: Manifest):
    order = [20, *range(20)]
    own = OwnJoints(joints=tuple(BODY21.joints[i] for i in order))
    caller = read(manifest, walking()[:, order].tolist(), skeleton=own).caller
    tree = caller.skeleton
    for joint, parent in zip(tree.joints, tree.parents, strict=True):
        expected = BODY21.parents[BODY21.index(joint)]
        assert (tree.joints[parent] if parent >= 0 else None) == (
            BODY21.joints[expected] if expected >= 0 else None
        )
    assert [own.joints[i] for i in caller.order] == list(tree.joints)


def test_given_parents_are_kept(manifest: Manifest):
    own = OwnJoints(joints=BODY21.joints, parents=BODY21.parents)
    tree = read(manifest, walking().tolist(), skeleton=own).caller.skeleton
    bones = {(tree.joints[p], j) for j, p in zip(tree.joints[1:], tree.parents[1:], strict=True)}
    assert ("left_lower_leg", "left_foot") in bones


@pytest.mark.parametrize(
    "parents",
    [BODY21.parents[:-1], (99, *BODY21.parents[1:]), (1, *BODY21.parents[1:]), (-1,) * 21],
)
def test_parents_that_are_no_tree_are_refused(manifest: Manifest, parents: tuple[int, ...]):
    own = OwnJoints(joints=BODY21.joints, parents=parents)
    with pytest.raises(UnknownSkeletonError, match="parents"):
        read(manifest, walking().tolist(), skeleton=own)


def test_map_to_a_joint_that_is_none_is_refused(manifest: Manifest):
    own = OwnJoints(joints=BODY21.joints, mapping={"hips": "tail"})
    with pytest.raises(UnknownSkeletonError, match="tail"):
        read(manifest, walking().tolist(), skeleton=own)


def test_too_few_joints_seen_is_said(manifest: Manifest):
    poses = walking().tolist()
    for frame in poses:
        frame[BODY21.index("left_foot")] = None
    with pytest.raises(PosesError, match="found no position of left_foot; too few joints"):
        read(manifest, poses)


def test_person_far_above_the_ground_is_brought_down(manifest: Manifest):
    observation = read(manifest, (walking() + np.array([0.0, 0.0, 3000.0])).tolist())
    assert observation.positions[-1, :, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert observation.caller.offset[2] > 2999.0


@SAME_BUNDLE
@given(
    shift=st.tuples(*[st.floats(-1e5, 1e5)] * 2),
    fps=st.floats(5.0, 300.0),
    extra=st.integers(0, 40),
    holes=st.lists(st.tuples(st.integers(0, 200), st.integers(0, 20)), max_size=12),
    units=st.sampled_from(["m", "cm", "mm"]),
    up=st.sampled_from(["x", "-x", "y", "-y", "z", "-z"]),
)
def test_any_person_is_read_near_the_origin(  # noqa: PLR0913 - one argument per strategy
    manifest: Manifest, shift, fps, extra, holes, units, up
):
    axes = Axes(units=units, up=up)
    world = walking(frames_needed(manifest, fps) + extra, fps=fps) + np.array([*shift, 0.0])
    poses = axes.from_metres(world).tolist()
    for frame, joint in holes:
        poses[frame % len(poses)][joint] = None
    try:
        observation = read(manifest, poses, fps=fps, axes=axes)
    except PosesError:
        if holes:
            return  # too much of the body is missing
        raise
    assert observation.positions.shape == (15, 21, 3)
    assert np.isfinite(observation.positions).all()
    assert np.abs(observation.positions).max() < 10.0
    assert np.isfinite(observation.caller.last_pose).all()
    if not holes:
        here = observation.positions[-1] + observation.caller.offset
        np.testing.assert_allclose(here, world[-1], atol=1e-5)


JSON = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=3),
    lambda children: (
        st.lists(children, max_size=4) | st.dictionaries(st.text(), children, max_size=2)
    ),
    max_leaves=20,
)


@SAME_BUNDLE
@given(poses=st.lists(JSON, max_size=4), value=JSON, frame=st.integers(0, 14), whole=st.booleans())
def test_any_json_is_read_or_refused_with_a_pointer(manifest: Manifest, poses, value, frame, whole):
    nearly = walking().tolist()
    if whole:
        nearly[frame] = value
    else:
        nearly[frame][5] = value
    for candidate in (poses, nearly):
        try:
            observation = read(manifest, candidate)
        except InputError as error:
            pointer = error.pointer or ""
        else:
            pointer = "/poses"
            assert np.isfinite(observation.positions).all()
        assert pointer.startswith(("/poses", "/axes"))


def test_root_of_a_scene_is_no_part_of_the_body(manifest: Manifest):
    poses = walking() + np.array([40.0, 0.0, 0.0])
    scene = np.concatenate([np.zeros((15, 1, 3)), poses], axis=1)
    own = OwnJoints(
        joints=("joint_Root", *BODY21.joints), parents=(-1, *(p + 1 for p in BODY21.parents))
    )
    observation = read(manifest, scene.tolist(), skeleton=own)
    np.testing.assert_allclose(
        observation.positions, read(manifest, poses.tolist()).positions, atol=1e-6
    )
    last = np.repeat(observation.positions[None, -1:], 60, axis=1)
    answer = caller_futures(last, observation, manifest=manifest, bone_lengths="observed")
    np.testing.assert_allclose(answer[0, -1], scene[-1, list(observation.caller.order)], atol=1e-5)
