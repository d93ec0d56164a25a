"""Futures as files for animation tools: one as it is, several in a zip, on one rest pose."""

import io
from collections.abc import Callable, Mapping, Sequence
from typing import Any
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import orjson
from jaxtyping import Float

from models.motion.formats.bvh import write_bvh
from models.motion.formats.gltf import write_glb
from models.motion.kinematics import inverse_kinematics, rest_pose
from models.motion.motion import Motion
from service.media import BVH, GLB, ZIP
from service.observation import Caller


def _bvh(motion: Motion) -> bytes:
    file = io.StringIO()
    write_bvh(file, motion)
    return file.getvalue().encode()


def _glb(motion: Motion) -> bytes:
    file = io.BytesIO()
    write_glb(file, motion)
    return file.getvalue()


_WRITERS: Mapping[str, tuple[str, Callable[[Motion], bytes]]] = {
    BVH: ("bvh", _bvh),
    GLB: ("glb", _glb),
}


def download(
    futures: Sequence[Float[np.ndarray, "_ J 3"]],
    caller: Caller,
    media_type: str,
    *,
    about: dict[str, Any],
) -> tuple[bytes, dict[str, str]]:
    """The file of a future, or a zip of one for each beside ``answer.json``, and its headers.

    Futures are metres, +Z up, in the order of the caller's tree.
    """
    suffix, write = _WRITERS[media_type]
    rest = _rest(caller)
    width = len(str(len(futures) - 1))
    files = {
        f"future-{i:0{width}d}.{suffix}": write(
            Motion(
                name=f"future-{i:0{width}d}",
                skeleton=caller.skeleton,
                positions=future,
                fps=caller.fps,
                rotations=inverse_kinematics(future, rest, caller.skeleton.parents),
                rest_offsets=rest,
            )
        )
        for i, future in enumerate(futures)
    }
    if len(files) == 1:
        ((name, content),) = files.items()
        return content, _headers(name, media_type)
    packed = io.BytesIO()
    with ZipFile(packed, "w", ZIP_DEFLATED, compresslevel=1) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
        archive.writestr("answer.json", orjson.dumps(about))
    return packed.getvalue(), _headers("futures.zip", ZIP)


def _headers(name: str, media_type: str) -> dict[str, str]:
    return {"Content-Type": media_type, "Content-Disposition": f'attachment; filename="{name}"'}


def _rest(caller: Caller) -> Float[np.ndarray, "J 3"]:
    """The rest pose of the person as last seen, with the bones' lengths over all frames."""
    rest = rest_pose(caller.last_pose[None].astype(np.float64), caller.skeleton)
    lengths = np.linalg.norm(rest, axis=-1, keepdims=True)
    bones: np.ndarray = rest / np.maximum(lengths, 1e-9) * caller.bones[:, None]
    return bones
