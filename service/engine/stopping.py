"""The rule by which an action ends: where the body has come to rest (Mao et al. 2022, Eq. 8)."""

import numpy as np
from jaxtyping import Float, Int64


def rest_frames(
    frames: Float[np.ndarray, "n F J 3"],
    *,
    start: Int64[np.ndarray, "n"],
    window: int,
    threshold_m: float,
) -> Int64[np.ndarray, "n"]:
    """Each row's first frame, its ``start`` or later, from which poses stay near their mean.

    They do so for a window; -1 where the frames have no such window. The distance of two poses, in
    metres, is that of all joints as one vector; its mean over the window is compared with the
    threshold.
    """
    rest = np.full(len(frames), -1, np.int64)
    num_windows = frames.shape[1] - window + 1
    due = np.flatnonzero(start < num_windows)
    if not len(due):
        return rest
    first = start[due].min()
    poses = frames[due, first:].reshape(len(due), frames.shape[1] - first, -1).astype(np.float64)
    moments = [poses[:, i : i + num_windows - first] for i in range(window)]
    mean = sum(moments[1:], start=moments[0]) / window
    offsets = (moment - mean for moment in moments)
    spread = sum(np.sqrt(np.einsum("nfd,nfd->nf", offset, offset)) for offset in offsets) / window
    is_rest = (spread < threshold_m) & (first + np.arange(num_windows - first) >= start[due, None])
    found = is_rest.any(axis=1)
    rest[due[found]] = first + is_rest[found].argmax(axis=1)
    return rest
