import io

import numpy as np
import pygltflib
import pytest
from tiny_bundles import standing_pose, walking

from models.motion import rotations as rot
from models.motion.formats.errors import UnsupportedFileError
from models.motion.formats.gltf import write_glb
from models.motion.kinematics import bone_lengths, fit_bone_lengths
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, Skeleton


def read(motion: Motion) -> pygltflib.GLTF2:
    """By a library of others, from the bytes that we write."""
    file = io.BytesIO()
    write_glb(file, motion)
    return pygltflib.GLTF2().load_from_bytes(file.getvalue())


def array(document: pygltflib.GLTF2, index: int) -> np.ndarray:
    accessor = document.accessors[index]
    view = document.bufferViews[accessor.bufferView]
    dtype = {5126: "<f4", 5123: "<u2", 5125: "<u4"}[accessor.componentType]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
    binary = document.binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
    values = np.frombuffer(binary, dtype).reshape(accessor.count, width)
    np.testing.assert_allclose(accessor.min, values.min(axis=0), rtol=1e-6)
    np.testing.assert_allclose(accessor.max, values.max(axis=0), rtol=1e-6)
    return values


def played(document: pygltflib.GLTF2, num_frames: int) -> dict[str, np.ndarray]:
    """Where every node is in every frame (T, 3) in our axes, by the rules of glTF."""
    channels = {}
    for channel in document.animations[0].channels:
        sampler = document.animations[0].samplers[channel.sampler]
        values = array(document, sampler.output)
        assert len(values) == len(array(document, sampler.input)) == num_frames
        channels[channel.target.node, channel.target.path] = values
    parents = {child: i for i, node in enumerate(document.nodes) for child in node.children or ()}
    places: dict[int, np.ndarray] = {}
    turned: dict[int, np.ndarray] = {}
    for i in document.skins[0].joints:
        node = document.nodes[i]
        still = np.tile(np.array(node.translation), (num_frames, 1))
        place = channels.get((i, "translation"), still).astype(np.float64)
        local = channels[i, "rotation"][:, [3, 0, 1, 2]].astype(np.float64)
        if i in parents:
            place = places[parents[i]] + rot.rotate(turned[parents[i]], place)
            local = rot.multiply(turned[parents[i]], local)
        places[i], turned[i] = place, local
    return {document.nodes[i].name: place[:, [2, 0, 1]] for i, place in places.items()}


def bodies() -> list[Motion]:
    rng = np.random.default_rng(0)
    noisy = walking(40) + 0.02 * rng.normal(size=(40, 21, 3))
    lengths = bone_lengths(standing_pose(), BODY21.parents)
    loose = fit_bone_lengths(noisy, lengths, BODY21.parents)
    return [
        Motion(name=name, skeleton=BODY21, positions=poses, fps=30.0)
        for name, poses in {"walk": walking(40), "loose": loose, "soft": noisy}.items()
    ]


@pytest.mark.parametrize("motion", bodies(), ids=lambda m: m.name)
def test_played_joints_are_where_they_were(motion: Motion):
    document = read(motion)
    places = played(document, motion.num_frames)
    found = np.stack([places[joint] for joint in BODY21.joints], axis=1)
    assert np.linalg.norm(found - motion.positions, axis=-1).max() < 2e-4
    times = array(document, document.animations[0].samplers[0].input)[:, 0]
    np.testing.assert_allclose(times, np.arange(40) / 30.0, atol=1e-6)


def test_skin_at_rest_is_the_octahedra_around_the_bones():
    document = read(bodies()[0])
    inverse = array(document, document.skins[0].inverseBindMatrices).reshape(-1, 4, 4)
    joints = -inverse[:, 3, :3]
    primitive = document.meshes[0].primitives[0]
    points = array(document, primitive.attributes.POSITION)
    followed = array(document, primitive.attributes.JOINTS_0)[:, 0]
    assert (array(document, primitive.attributes.WEIGHTS_0) == [1, 0, 0, 0]).all()
    tips, starts = slice(5, None, 6), slice(0, None, 6)
    np.testing.assert_allclose(points[tips], joints[followed[tips]], atol=1e-6)
    np.testing.assert_allclose(points[starts], joints[followed[starts]], atol=1e-6)
    triangles = points[array(document, primitive.indices).reshape(-1, 3)]
    middles = np.repeat(points.reshape(-1, 6, 3).mean(axis=1), 8, axis=0)
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    assert ((triangles.mean(axis=1) - middles) * normals).sum(axis=-1).min() > 0.0


def test_file_is_aligned_as_glb_must_be():
    file = io.BytesIO()
    write_glb(file, bodies()[0])
    content = file.getvalue()
    assert content[:8] == b"glTF\x02\0\0\0"
    assert int.from_bytes(content[8:12], "little") == len(content)
    assert int.from_bytes(content[12:16], "little") % 4 == 0
    assert all(view.byteOffset % 4 == 0 for view in read(bodies()[0]).bufferViews)


def test_one_point_is_no_body():
    point = Skeleton(name="point", joints=("a",), parents=(-1,))
    motion = Motion(name="x", skeleton=point, positions=np.zeros((2, 1, 3)), fps=30.0)
    with pytest.raises(UnsupportedFileError, match="no bones"):
        read(motion)
