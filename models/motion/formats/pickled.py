"""npz files that hold a pickled dictionary, as research code passes its data on."""

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from models.motion.formats.errors import MalformedFileError


def holds_key(path: Path, key: str) -> bool:
    """Whether an npz file has an array of this name; damaged files have not."""
    try:
        with zipfile.ZipFile(path) as archive:
            return f"{key}.npy" in archive.namelist()
    except (OSError, zipfile.BadZipFile):
        return False


def read_dictionary(path: Path, key: str) -> dict[Any, Any]:
    """The dictionary under a key.

    A pickle can run code when it is read: read only files from those you trust.

    Raises:
        MalformedFileError: the file is damaged, or something else is there.
    """
    where = f"{path.name}: {key}"
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, zlib.error, EOFError) as error:
        damaged = str(error)
    if damaged:
        raise MalformedFileError(where, found=f"damage ({damaged})", right="get the file again")
    with np.load(path, allow_pickle=True) as arrays:
        found = arrays[key]
    value = found.item() if found.shape == () else found
    if not isinstance(value, dict):
        raise MalformedFileError(
            where, found=type(value).__name__, right="must be a pickled dictionary"
        )
    return value
