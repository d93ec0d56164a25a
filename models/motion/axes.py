"""Coordinates: which axis points up, how long a unit is, and whether they are right-handed."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
Units = Literal["m", "cm", "mm"]
Handed = Literal["right", "left"]

UNITS_PER_METRE: dict[Units, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0}

# Rows give our x, y and z in the others' axes; all are rotations, so nobody is mirrored.
_TO_Z_UP: dict[Up, tuple[tuple[int, int, int], ...]] = {
    "x": ((0, 1, 0), (0, 0, 1), (1, 0, 0)),
    "-x": ((0, 1, 0), (0, 0, -1), (-1, 0, 0)),
    "y": ((0, 0, 1), (1, 0, 0), (0, 1, 0)),
    "-y": ((0, 0, 1), (-1, 0, 0), (0, -1, 0)),
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Axes:
    """Axes with an up direction and a unit; `handed` is left in Unity and Unreal."""

    up: Up = "z"
    units: Units = "m"
    handed: Handed = "right"

    def to_metres(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points in these axes as metres, +Z up, right-handed."""
        in_metres = points / UNITS_PER_METRE[self.units]
        return _turned(in_metres, self._matrix())

    def from_metres(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points in metres, +Z up, right-handed, in these axes."""
        return _turned(points, self._matrix().T * UNITS_PER_METRE[self.units])

    def _matrix(self) -> Float[np.ndarray, "3 3"]:
        matrix = np.array(_TO_Z_UP[self.up], dtype=np.float64)
        if self.handed == "left":  # a left-handed world is a right-handed one seen in a mirror
            matrix[1] *= -1.0
        return matrix


def _turned(
    points: Float[np.ndarray, "*batch 3"], matrix: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Points times a matrix that has one number in each row, as they lie in memory."""
    turned = np.empty_like(points, dtype=np.float64)
    for axis, row in enumerate(matrix):
        source = int(np.flatnonzero(row)[0])
        np.multiply(points[..., source], row[source], out=turned[..., axis])
    return turned
