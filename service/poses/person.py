"""Whether positions can be those of one person; says so where the units look wrong."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from models.motion.axes import UNITS_PER_METRE, Units
from service.errors import PosesError

MAX_COORDINATE_M = 1e7  # the largest that maps use
MIN_SIZE_M, MAX_SIZE_M = 0.3, 5.0  # diagonal of the box around a person
MAX_REACH_M = 5.0  # of a joint from the middle of the body

_UNIT_NAMES: dict[Units, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}


def check_person(world: Float[np.ndarray, "T J 3"], *, order: Sequence[int], units: Units) -> None:
    """Refuse positions in metres, NaN where unseen, that no person can have.

    ``order`` gives each joint's index in the caller's lists, for the error's pointer.

    Raises:
        PosesError: a coordinate is absurd, or the body is much too large or small.
    """
    seen = np.isfinite(world[:, :, 0])
    if not seen.any():
        raise PosesError(
            pointer="/poses", found="no joint", expected="at least both legs and arms must be seen"
        )
    points = np.where(seen[:, :, None], world, 0.0)
    _refuse_where(
        np.abs(points).max(axis=-1),
        limit=MAX_COORDINATE_M,
        order=order,
        what="from the origin of the world",
    )
    counts = seen.sum(axis=1)
    rows, last = np.arange(len(world)), np.maximum(counts, 1) - 1
    ranked = np.sort(world, axis=1)  # NaN comes last
    size = np.linalg.norm(ranked[rows, last] - ranked[:, 0], axis=-1)
    _check_size(float(np.median(size[counts > 0])), units)
    middle = (ranked[rows, last // 2] + ranked[rows, (last + 1) // 2]) / 2.0
    reach = np.where(seen, np.linalg.norm(points - middle[:, None], axis=-1), 0.0)
    _refuse_where(reach, limit=MAX_REACH_M, order=order, what="from the middle of the body")


def _check_size(size: float, units: Units) -> None:
    if MIN_SIZE_M <= size <= MAX_SIZE_M:
        return
    found = f"a body {size:.3g} m across"
    for other, per_metre in UNITS_PER_METRE.items():
        if 0.7 <= size * UNITS_PER_METRE[units] / per_metre <= 3.5:
            raise PosesError(
                pointer="/axes/units",
                found=f"{found} where units are {units!r}",
                expected=f"it looks like {_UNIT_NAMES[other]}: say axes.units = {other!r}",
            )
    raise PosesError(
        pointer="/poses",
        found=found,
        expected=f"a person is {MIN_SIZE_M} to {MAX_SIZE_M:g} m across",
    )


def _refuse_where(
    distance: Float[np.ndarray, "T J"], *, limit: float, order: Sequence[int], what: str
) -> None:
    if distance.max() > limit:
        frame, joint = np.unravel_index(int(np.argmax(distance)), distance.shape)
        raise PosesError(
            pointer=f"/poses/{frame}/{order[int(joint)]}",
            found=f"a joint {distance[frame, joint]:.3g} m {what}",
            expected=f"no joint is farther than {limit:g} m",
        )
