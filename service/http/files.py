"""Motion files that are sent: what is in them, as the fields of a request."""

from asyncio import to_thread
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from fastapi import APIRouter, Query, Request, Response

from models.motion.bones import bone_parents
from models.motion.formats.errors import FormatError, MalformedFileError, UnsupportedFileError
from models.motion.formats.files import SUFFIXES, read_motion
from models.motion.formats.pose_json import request_fields, with_nulls
from models.motion.motion import Motion
from service import schemas
from service.errors import (
    BodyTooLargeError,
    FieldError,
    MotionFileError,
    NotAcceptableError,
    OverloadedError,
    RateLimitedError,
    UnauthorisedError,
)
from service.http.body import BodyRoute, read_body
from service.http.dependencies import TheSettings
from service.http.problems import declared
from service.media import DOCUMENTS, JSON, accepted, encoded

MAX_FPS = 60.0
ARCHIVE = ".zip"

router = APIRouter(route_class=BodyRoute, responses=declared(UnauthorisedError))


@router.post(
    "/observations",
    response_model=schemas.FileObservation,
    responses=declared(
        NotAcceptableError, BodyTooLargeError, FieldError, RateLimitedError, OverloadedError
    ),
    openapi_extra={
        "requestBody": {
            "required": True,
            "content": {
                "application/octet-stream": {"schema": {"type": "string", "format": "binary"}}
            },
        }
    },
)
async def observations(
    http: Request,
    settings: TheSettings,
    name: Annotated[
        str,
        Query(
            description=f"of the file; its suffix is one of {', '.join(SUFFIXES)}, or {ARCHIVE} "
            "where one file needs others beside it, as an .amc its .asf"
        ),
    ],
    start_s: Annotated[float, Query(ge=0, allow_inf_nan=False, description="cut before")] = 0.0,
    end_s: Annotated[
        float | None, Query(gt=0, allow_inf_nan=False, description="cut after; the end by default")
    ] = None,
) -> Response:
    """The motion in a file, at most 60 frames a second, as POST /predict takes it."""
    media_type = accepted(http.headers.get("accept", ""), DOCUMENTS)
    body = await read_body(http, limit=settings.max_body_bytes)

    def answer() -> bytes:
        motion = read_sent(body, name, limit=settings.max_body_bytes)
        return encoded(_fields(motion, start_s, end_s, media_type), media_type)

    return Response(await to_thread(answer), media_type=media_type)


def read_sent(body: bytes, name: str, *, limit: int) -> Motion:
    """The motion in the bytes of a file, or of a zip of few files of which one is a motion.

    Raises:
        MotionFileError: it is damaged, or of a kind that is not read.
        BodyTooLargeError: unpacked, it has more than ``limit`` bytes.
    """
    plain = Path(name.replace("\\", "/")).name
    with TemporaryDirectory(prefix="posefutures-") as folder:
        path = Path(folder) / (plain or "unnamed")
        try:
            path.write_bytes(body)
            _check_unpacked(path, limit=limit)
            return read_motion(_unpacked(path) if path.suffix.lower() == ARCHIVE else path)
        except FormatError as error:
            raise _unreadable(str(error.found), error.right, error) from error
        except (OSError, ValueError) as error:  # a name that no file can have
            raise _unreadable(repr(plain[:40]), "its name must be that of a file", error) from error


def _unreadable(found: str, expected: str, error: Exception) -> MotionFileError:
    failure = MotionFileError(pointer="", found=found, expected=expected)
    if isinstance(error, FormatError):
        failure.detail = str(error)
    return failure


def _check_unpacked(path: Path, *, limit: int) -> None:
    """Zips, of which npz files are some, may hold much more than they weigh."""
    try:
        with ZipFile(path) as archive:
            size = sum(part.file_size for part in archive.infolist())
    except BadZipFile:
        return
    if size > limit:
        raise BodyTooLargeError(
            f"the body: found {size} bytes in {path.name[:60]}; at most {limit} are read.",
            found=f"{size} bytes",
            expected=f"at most {limit} bytes",
        )


def _unpacked(path: Path) -> Path:
    """The one motion file in a zip, beside whatever else is in it."""
    folder = path.parent / "unpacked"
    folder.mkdir()
    try:
        with ZipFile(path) as archive:
            for part in archive.infolist():
                if not part.is_dir():
                    (folder / Path(part.filename).name).write_bytes(archive.read(part))
    except (BadZipFile, RuntimeError, NotImplementedError) as error:
        raise MalformedFileError(path.name, found=str(error), right="must be a zip") from error
    motions = sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES)
    if len(motions) > 1 and all(p.suffix.lower() == ".json" for p in motions):
        return folder  # frames, a file for each
    if len(motions) != 1:
        raise UnsupportedFileError(
            path.name,
            found=f"{len(motions)} motions",
            right="a zip must hold one file that is a motion, and what that needs beside it",
        )
    return motions[0]


def _fields(motion: Motion, start_s: float, end_s: float | None, media_type: str) -> dict[str, Any]:
    cut = _cut(motion, start_s, end_s)
    fields = request_fields(cut.resample(MAX_FPS) if cut.fps > MAX_FPS else cut)
    poses = fields["poses"].astype(np.float32)
    holes = bool(np.isnan(poses).any())
    return fields | {
        "poses": with_nulls(fields["poses"]) if holes and media_type == JSON else poses,
        "parents": list(bone_parents(cut.skeleton)),
        "start_s": start_s,
        "duration_s": motion.duration,
    }


def _cut(motion: Motion, start_s: float, end_s: float | None) -> Motion:
    first = round(start_s * motion.fps)
    last = motion.num_frames if end_s is None else round(end_s * motion.fps) + 1
    if first >= min(last, motion.num_frames):
        raise FieldError(
            pointer="/query/start_s",
            found=f"{start_s:g} s",
            expected=f"the file lasts from 0 s to {motion.duration:.2f} s, and it must be before "
            "end_s",
        )
    return motion[first:last]
