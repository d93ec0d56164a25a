"""Animated GLB files (glTF 2.0): a rig, and octahedra for its bones so that there is a body to see.

glTF is Y-up and its people face +Z: our (x, y, z) become (y, z, x).
"""

import json
import struct
from io import BufferedIOBase, BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from models.motion.formats.errors import UnsupportedFileError
from models.motion.motion import Motion
from models.motion.rig import Rig, rigged

_COMPONENTS = {"float32": 5126, "uint16": 5123, "uint32": 5125}
_SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (16,): "MAT4"}
_VERTICES, _INDICES = 34962, 34963  # what a view of the buffer is for
_RADIUS_M = 0.02
_RING = 0.15  # where an octahedron is thickest, as a part of its bone
_FACES = [(5, 1 + i, 1 + (i + 1) % 4) for i in range(4)] + [
    (0, 1 + (i + 1) % 4, 1 + i) for i in range(4)
]
_COLOUR = [0.75, 0.78, 0.82, 1.0]


class _Buffer:
    """The binary part, and what the JSON says of the arrays in it."""

    def __init__(self) -> None:
        self.content = BytesIO()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: Shaped[np.ndarray, "N *shape"], *, target: int | None = None) -> int:
        """The index of the accessor of an array."""
        start = self.content.tell()
        little = array.astype(array.dtype.newbyteorder("<"), copy=False)
        self.content.write(little.tobytes())
        view = {"buffer": 0, "byteOffset": start, "byteLength": array.nbytes}
        self.views.append(view if target is None else view | {"target": target})
        self.content.write(bytes(-self.content.tell() % 4))
        flat = array.reshape(len(array), -1)
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": _COMPONENTS[array.dtype.name],
                "count": len(array),
                "type": _SHAPES[array.shape[1:]],
                "min": flat.min(axis=0).tolist(),
                "max": flat.max(axis=0).tolist(),
            }
        )
        return len(self.accessors) - 1


def write_glb(path_or_file: Path | BufferedIOBase, motion: Motion) -> None:
    """Writes a motion without gaps as an animated GLB, its joints as a skin's.

    Raises:
        UnsupportedFileError: It has no bones.
    """
    if isinstance(path_or_file, Path):
        with path_or_file.open("wb") as file:
            write_glb(file, motion)
        return
    rig = rigged(motion)
    buffer = _Buffer()
    document = {
        "asset": {"version": "2.0", "generator": "posefutures"},
        "scene": 0,
        "scenes": [{"nodes": [0, len(rig.joints)]}],
        "nodes": [*_nodes(rig), {"name": motion.name, "mesh": 0, "skin": 0}],
        "meshes": [{"name": motion.name, "primitives": [_body(motion, rig, buffer)]}],
        "materials": [
            {
                "name": "bone",
                "pbrMetallicRoughness": {
                    "baseColorFactor": _COLOUR,
                    "metallicFactor": 0.0,
                    "roughnessFactor": 0.7,
                },
            }
        ],
        "skins": [_skin(rig, buffer)],
        "animations": [_animation(motion, rig, buffer)],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": buffer.content.tell()}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = buffer.content.getvalue()
    size = 12 + 8 + len(text) + 8 + len(binary)
    path_or_file.write(struct.pack("<4sII", b"glTF", 2, size))
    path_or_file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    path_or_file.write(struct.pack("<I4s", len(binary), b"BIN\0") + binary)


def _turned(points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
    return points[..., [1, 2, 0]]


def _nodes(rig: Rig) -> list[dict[str, Any]]:
    places = _turned(rig.rest)
    places[0] = _turned(rig.translations[0, 0])
    nodes: list[dict[str, Any]] = []
    for joint, children in enumerate(rig.children):
        node = {"name": rig.joints[joint], "translation": places[joint].tolist()}
        nodes.append(node | {"children": list(children)} if children else node)
    return nodes


def _rest_positions(rig: Rig) -> Float[np.ndarray, "J 3"]:
    """Joints of the rest pose with the root at the origin, in glTF's axes."""
    places = np.zeros_like(rig.rest)
    for joint, parent in enumerate(rig.parents):
        if parent >= 0:
            places[joint] = places[parent] + rig.rest[joint]
    return _turned(places)


def _skin(rig: Rig, buffer: _Buffer) -> dict[str, Any]:
    inverse = np.tile(np.eye(4, dtype=np.float32), (len(rig.joints), 1, 1))
    inverse[:, 3, :3] = -_rest_positions(rig)  # column-major
    joints = list(range(len(rig.joints)))
    matrices = buffer.add(inverse.reshape(-1, 16))
    return {"joints": joints, "skeleton": 0, "inverseBindMatrices": matrices}


def _body(motion: Motion, rig: Rig, buffer: _Buffer) -> dict[str, Any]:
    """An octahedron for each bone, whose tip follows the child and whose rest the parent."""
    places = _rest_positions(rig)
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    followed: list[list[int]] = []
    for joint, parent in enumerate(rig.parents):
        bone = places[joint] - places[parent]
        length = float(np.linalg.norm(bone))
        if parent < 0 or length < 1e-4:
            continue
        along = bone / length
        across = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        across *= min(_RADIUS_M, length / 3.0) / np.linalg.norm(across)
        other = np.cross(along, across)
        ring = places[parent] + _RING * bone + np.array([across, other, -across, -other])
        faces.append(np.array(_FACES) + 6 * len(vertices))
        vertices.append(np.concatenate([places[parent][None], ring, places[joint][None]]))
        followed.append([parent] * 5 + [joint])
    if not vertices:
        raise UnsupportedFileError(motion.name, found="no bones", right="a body has some")
    influences = np.zeros((6 * len(vertices), 4), dtype=np.uint16)
    influences[:, 0] = np.concatenate(followed)
    weights = np.tile(np.array([1, 0, 0, 0], dtype=np.float32), (len(influences), 1))
    points = np.concatenate(vertices).astype(np.float32)
    return {
        "attributes": {
            "POSITION": buffer.add(points, target=_VERTICES),
            "JOINTS_0": buffer.add(influences, target=_VERTICES),
            "WEIGHTS_0": buffer.add(weights, target=_VERTICES),
        },
        "indices": buffer.add(np.concatenate(faces).astype(np.uint32).ravel(), target=_INDICES),
        "material": 0,
    }


def _animation(motion: Motion, rig: Rig, buffer: _Buffer) -> dict[str, Any]:
    times = buffer.add((np.arange(motion.num_frames) / motion.fps).astype(np.float32))
    quaternions = rig.rotations[..., [2, 3, 1, 0]].astype(np.float32)  # (x, y, z, w), Y-up
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    channels: list[dict[str, Any]] = []
    samplers: list[dict[str, Any]] = []

    def animate(joint: int, path: str, values: Float[np.ndarray, "T D"]) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": joint, "path": path}})
        output = buffer.add(np.ascontiguousarray(values))
        samplers.append({"input": times, "interpolation": "LINEAR", "output": output})

    for joint in range(len(rig.joints)):
        animate(joint, "rotation", quaternions[:, joint])
        if rig.moving[joint]:
            places = _turned(rig.translations[:, joint]).astype(np.float32)
            animate(joint, "translation", places)
    return {"name": motion.name, "channels": channels, "samplers": samplers}
