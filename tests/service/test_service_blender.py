"""Downloads in Blender itself: `pip install bpy==4.5.15` beside the rest, in Python 3.11."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_memory import JSON, Service, dumped
from tiny_bundles import FPS, HORIZON, walking

from models.motion.skeleton import BODY21
from service.media import BVH, GLB

bpy = pytest.importorskip("bpy")

# Blender's reader of BVH leaves the file open.
pytestmark = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

WALK = walking()
OPTIONS = {"seed": 3, "num_samples": 1}
# What is +X of ours is forward in a file whose up is +Y, and -Y in Blender.
FROM_BLENDER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.fixture(autouse=True)
def empty_scene() -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = round(FPS)


def downloaded(service: Service, path: Path, media_type: str, **fields: Any) -> Path:
    content = dumped({"poses": WALK} | OPTIONS | fields)
    headers = JSON | {"accept": media_type}
    path.write_bytes(service.request("POST", "/predict", content=content, headers=headers).content)
    return path


def joint_positions(first_frame: int) -> np.ndarray:
    """(H, 21, 3) metres, in our axes, of the one armature that there is."""
    (armature,) = (thing for thing in bpy.data.objects if thing.type == "ARMATURE")
    (action,) = bpy.data.actions
    assert tuple(action.frame_range) == (first_frame, first_frame + HORIZON - 1)
    found = np.empty((HORIZON, BODY21.num_joints, 3))
    for index in range(HORIZON):
        bpy.context.scene.frame_set(first_frame + index)
        posed = armature.evaluated_get(bpy.context.evaluated_depsgraph_get())
        for joint, name in enumerate(BODY21.joints):
            found[index, joint] = posed.matrix_world @ posed.pose.bones[name].head
    return found @ FROM_BLENDER.T


@pytest.mark.parametrize("lengths", ["observed", "free"])
def test_a_bvh_has_the_positions_and_the_rate_of_the_answer(
    service: Service, tmp_path: Path, lengths: str
):
    path = downloaded(service, tmp_path / "future.bvh", BVH, bone_lengths=lengths)
    bpy.context.scene.render.fps = 24
    bpy.ops.import_anim.bvh(filepath=str(path), global_scale=0.01, update_scene_fps=True)
    assert bpy.context.scene.render.fps == FPS
    expected = service.futures(WALK, bone_lengths=lengths, **OPTIONS)[0]
    assert np.linalg.norm(joint_positions(1) - expected, axis=-1).max() < 1e-3


def test_a_glb_has_the_positions_and_the_rate_of_the_answer(service: Service, tmp_path: Path):
    path = downloaded(service, tmp_path / "future.glb", GLB)
    bpy.ops.import_scene.gltf(filepath=str(path))
    expected = service.futures(WALK, **OPTIONS)[0]
    assert np.linalg.norm(joint_positions(0) - expected, axis=-1).max() < 1e-3
