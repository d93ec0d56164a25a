"""The rule by which an action ends: where the body has come to rest (Mao et al. 2022, Eq. 8)."""

import numpy as np
from jaxtyping import Float


def rest_frame(
    frames: Float[np.ndarray, "F J 3"], *, start: int, window: int, threshold_m: float
) -> int | None:
    """First frame, ``start`` or later, from which the poses of a window stay near their mean.

    None if the frames have no such window. The distance of two poses, in metres, is that of all
    joints as one vector; its mean over the window is compared with the threshold.
    """
    poses = frames[start:].reshape(-1, frames[0].size).astype(np.float64)  # (F - start, J·3)
    if len(poses) < window:
        return None
    windows = np.lib.stride_tricks.sliding_window_view(poses, window, axis=0)  # (i, J·3, window)
    offsets = windows - windows.mean(axis=-1, keepdims=True)
    spread = np.linalg.norm(offsets, axis=1).mean(axis=-1)  # (i,)
    at_rest = np.flatnonzero(spread < threshold_m)
    return start + int(at_rest[0]) if len(at_rest) else None
