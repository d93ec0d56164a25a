"""The caller's coordinates: which axis points up, and how long a unit is."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
Units = Literal["m", "cm", "mm"]

UNITS_PER_METRE: dict[Units, float] = {"m": 1.0, "cm": 100.0, "mm": 1000.0}

# Rows give our x, y and z in the caller's axes; all are rotations, so nobody is mirrored.
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
    """Right-handed axes with an up direction and a unit."""

    up: Up = "z"
    units: Units = "m"

    def to_metres(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """The caller's points in metres, Z up."""
        return np.asarray((points / UNITS_PER_METRE[self.units]) @ self._matrix().T)

    def from_metres(self, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, "*batch 3"]:
        """Points in metres, Z up, as the caller writes them."""
        return np.asarray(points @ self._matrix() * UNITS_PER_METRE[self.units])

    def _matrix(self) -> Float[np.ndarray, "3 3"]:
        return np.array(_TO_Z_UP[self.up], dtype=np.float64)
