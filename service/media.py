"""The media types that go over HTTP, in and out: JSON, MessagePack, npz, two streams and motions.

An array is nested lists in JSON; in MessagePack the map {"shape": [...], "dtype": "float32",
"data": its little-endian bytes}; in an npz an array of its own, named by its path, such as
``futures/0/poses``, beside ``meta``, which is the rest as JSON with null in the array's place.
"""

import json
import re
import zlib
from collections.abc import Sequence
from io import BytesIO
from typing import Any, TypeAlias
from zipfile import BadZipFile, ZipFile

import msgpack
import numpy as np
import orjson
from jaxtyping import Shaped

from service.errors import BodyTooLargeError, MalformedBodyError, MediaTypeError, NotAcceptableError

JSON = "application/json"
MSGPACK = "application/msgpack"
NPZ = "application/x-npz"
EVENT_STREAM = "text/event-stream"
NDJSON = "application/x-ndjson"
BVH = "model/bvh"
GLB = "model/gltf-binary"
ZIP = "application/zip"

DOCUMENTS = (JSON, MSGPACK, NPZ)
MOTIONS = (BVH, GLB)
STREAMS = (EVENT_STREAM, NDJSON)

_Arrays: TypeAlias = dict[str, Shaped[np.ndarray, "..."]]

_ALIASES = {"application/x-msgpack": MSGPACK, "application/vnd.msgpack": MSGPACK}
_META = "meta"
PIECE = 2**13
"""Numbers that are written in about a quarter of a millisecond."""
_DTYPES = ("float16", "float32", "float64")
_QUALITY = re.compile(r";\s*q\s*=\s*(0(\.\d*)?|1(\.0*)?)\s*(;|$)", re.IGNORECASE)


def accepted(header: str, offered: Sequence[str]) -> str:
    """The offered media type that an Accept header likes best; the first of equals.

    Raises:
        NotAcceptableError: it likes none.
    """
    liked = dict(_liked(part) for part in header.split(",") if part.strip()) or {"*/*": 1.0}

    def quality(media_type: str) -> float:
        ranges = (media_type, f"{media_type.split('/')[0]}/*", "*/*")
        return next((liked[name] for name in ranges if name in liked), 0.0)

    best = max(offered, key=quality)
    if quality(best) == 0.0:
        raise NotAcceptableError(
            f"accept: found {header[:100]}; this path answers in {', '.join(offered)}.",
            found=header[:100],
            expected=", ".join(offered),
        )
    return best


def sent(header: str) -> str:
    """The media type that a Content-Type header declares, of those that are read.

    Raises:
        MediaTypeError: it is none of them.
    """
    media_type = _bare(header)
    if media_type not in DOCUMENTS:
        found, expected = media_type[:60] or "none", ", ".join(DOCUMENTS)
        raise MediaTypeError(
            f"content-type: found {found}; it must be one of {expected}.",
            found=found,
            expected=expected,
        )
    return media_type


def encoded(content: dict[str, Any], media_type: str) -> bytes:
    """A document whose values may be arrays, of any type; streams carry JSON."""
    if media_type == MSGPACK:
        packed: bytes = msgpack.packb(content, default=_array_map)
        return packed
    if media_type == NPZ:
        arrays: _Arrays = {}
        meta = orjson.dumps(_lifted(content, "", arrays)).decode()
        file = BytesIO()
        np.savez(file, allow_pickle=False, **arrays, **{_META: np.array(meta)})
        return file.getvalue()
    return orjson.dumps(content, default=_fragments)


def decoded(body: bytes, media_type: str, *, limit: int) -> dict[str, Any]:
    """The object in a body; NaN and Infinity, which JSON lacks, are kept to be named later.

    Raises:
        MalformedBodyError: the body is not an object.
        BodyTooLargeError: unpacked, it has more than ``limit`` bytes.
    """
    read = {JSON: _from_json, MSGPACK: _from_msgpack}.get(media_type)
    content = read(body) if read else _from_npz(body, limit=limit)
    if not isinstance(content, dict):
        kind = _KINDS.get(type(content), "value")
        raise _malformed(f"a JSON {kind}" if media_type == JSON else f"an {kind}")
    return content


_KINDS = {list: "array", str: "string", int: "number", float: "number", bool: "boolean"} | {
    type(None): "null", np.ndarray: "array"
}  # fmt: skip


def _liked(part: str) -> tuple[str, float]:
    quality = _QUALITY.search(part)
    return _bare(part), float(quality[1]) if quality else 1.0


def _bare(header: str) -> str:
    name = header.split(";")[0].strip().lower()
    return _ALIASES.get(name, name)


def _array_map(array: Shaped[np.ndarray, "..."]) -> dict[str, Any]:
    little = array.astype(array.dtype.newbyteorder("<"), copy=False)
    return {"shape": array.shape, "dtype": array.dtype.name, "data": little.tobytes()}


def _fragments(array: Shaped[np.ndarray, "..."]) -> list[Any]:
    """The parts of an array one by one: while one is written, every other thread must wait."""
    return [
        _fragments(part)
        if part.size > PIECE
        else orjson.Fragment(orjson.dumps(part, option=orjson.OPT_SERIALIZE_NUMPY))
        for part in array
    ]


def _lifted(value: Any, name: str, arrays: _Arrays) -> Any:
    """A value with null for each array in it; those are put into ``arrays`` by their path."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return None
    prefix = f"{name}/" if name else ""
    if isinstance(value, dict):
        return {key: _lifted(part, f"{prefix}{key}", arrays) for key, part in value.items()}
    if isinstance(value, list):
        return [_lifted(part, f"{prefix}{i}", arrays) for i, part in enumerate(value)]
    return value


def _from_json(body: bytes) -> Any:
    try:
        return orjson.loads(body)
    except orjson.JSONDecodeError as error:
        try:
            return json.loads(body)
        except (ValueError, RecursionError):
            raise _malformed(f"no JSON: {error}") from error


def _from_msgpack(body: bytes) -> Any:
    try:
        return msgpack.unpackb(body, object_hook=_array_or_map)
    except (ValueError, TypeError) as error:  # msgpack's own errors are ValueErrors
        raise _malformed(f"no MessagePack: {_said(error)}") from error


def _array_or_map(content: dict[str, Any]) -> Any:
    if content.keys() != {"shape", "dtype", "data"}:
        return content
    if content["dtype"] not in _DTYPES:
        raise ValueError(f"an array of {str(content['dtype'])[:20]}, not of {', '.join(_DTYPES)}")
    little = np.dtype(content["dtype"]).newbyteorder("<")
    return np.frombuffer(content["data"], little).reshape(content["shape"])


def _from_npz(body: bytes, *, limit: int) -> dict[str, Any]:
    try:
        with ZipFile(BytesIO(body)) as archive:
            size = sum(part.file_size for part in archive.infolist())
            if size > limit:
                raise BodyTooLargeError(
                    f"the body: found {size} bytes in the npz; at most {limit} are read.",
                    found=f"{size} bytes",
                    expected=f"at most {limit} bytes",
                )
            arrays = {
                name.removesuffix(".npy"): _npy(archive.read(name)) for name in archive.namelist()
            }
        content = {name: _plain(array) for name, array in arrays.items()}
        meta = orjson.loads(content.pop(_META, "{}"))
        return {**meta, **content}
    except (BadZipFile, zlib.error, ValueError, TypeError, EOFError, NotImplementedError,
            RuntimeError) as error:  # fmt: skip  # zipfile and numpy share no base
        raise _malformed(f"no npz: {_said(error)}") from error


def _npy(file: bytes) -> Shaped[np.ndarray, "..."]:
    """The array in a .npy file; numpy's own reader would allocate what the header only claims."""
    stream = BytesIO(file)
    version = np.lib.format.read_magic(stream)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read_header is None:
        raise ValueError(f"an array of version {version}")
    shape, fortran_order, dtype = read_header(stream)
    flat = np.frombuffer(stream.read(), dtype)
    return flat.reshape(shape, order="F" if fortran_order else "C")


def _plain(array: Shaped[np.ndarray, "..."]) -> Any:
    """A number, a text or a short list as JSON has them; poses stay an array."""
    return array if array.ndim > 2 else array.tolist()


def _said(error: Exception) -> str:
    return " ".join(str(error).split())[:100] or type(error).__name__


def _malformed(found: str) -> MalformedBodyError:
    return MalformedBodyError(
        f"the body: found {found}; it must be a JSON object.",
        found=found,
        expected="a JSON object",
    )
