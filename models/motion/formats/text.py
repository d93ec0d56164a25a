"""Words and numbers of text formats, with the line they stand on."""

import math
from collections.abc import Sequence
from pathlib import Path

from models.motion.formats.errors import InvalidNumberError

LARGEST = 1e6  # above this a coordinate or an angle is garbage in any unit


def read_lines(path: Path) -> list[str]:
    """The lines of a text file; bytes that are no UTF-8 are replaced, not refused."""
    return path.read_text(encoding="utf-8", errors="replace").splitlines()


def numbers(words: Sequence[str], where: str) -> list[float]:
    """The numbers that words spell.

    Raises:
        InvalidNumberError: A word is no number, or it is not finite or too large.
    """
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = [math.nan]
    if any(not -LARGEST < value < LARGEST for value in values):
        bad = next(word for word in words if not _is_sensible(word))
        raise InvalidNumberError(
            where, found=repr(bad[:40]), right="every value must be a finite number below 1e6"
        )
    return values


def _is_sensible(word: str) -> bool:
    try:
        return -LARGEST < float(word) < LARGEST
    except ValueError:
        return False
