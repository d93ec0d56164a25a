"""What predictions are worth: the field's metrics, in float64 (Barquero et al. 2023).

`ade`, `fde`, `apd`, `mmade`, `mmfde` and motion per frame look at joints relative to the root, the
root itself dropped, a pose as one vector; `world_ade` and `world_fde` look at all joints in the
world. Every per-item metric returns one number for each of the B observations.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

Samples = Float[np.ndarray, "B S H J 3"]
Futures = Float[np.ndarray, "B H J 3"]
PerItem = Float[np.ndarray, "B"]
Limbs = Int[np.ndarray, "L 2"]


def ade(samples: Samples, future: Futures) -> PerItem:
    """Distance in metres of the poses, mean over time, best of S samples."""
    return _best(_errors(_root_relative(samples), _root_relative(future)).mean(axis=-1))


def fde(samples: Samples, future: Futures) -> PerItem:
    """Distance in metres of the last pose, best of S samples."""
    return _best(_errors(_root_relative(samples), _root_relative(future))[:, :, -1])


def world_ade(samples: Samples, future: Futures) -> PerItem:
    """`ade` of all joints where they are in the world."""
    return _best(_errors(_flat(samples), _flat(future)).mean(axis=-1))


def world_fde(samples: Samples, future: Futures) -> PerItem:
    """`fde` of all joints where they are in the world."""
    return _best(_errors(_flat(samples), _flat(future))[:, :, -1])


def apd(samples: Samples) -> PerItem:
    """Mean distance in metres over all pairs of samples, each a whole sequence as one vector.

    0 for a single sample (Yuan and Kitani 2020).
    """
    return mean_over_pairs(sample_distances(samples))


def sample_distances(samples: Samples) -> Float[np.ndarray, "B S S"]:
    """Distance in metres of every two samples, each a whole sequence as one vector."""
    sequences = _root_relative(samples).reshape(len(samples), samples.shape[1], -1)
    rows = (sequences - sequences[:, i, None] for i in range(sequences.shape[1]))
    return np.stack([np.linalg.norm(row, axis=-1) for row in rows], axis=1)


def mean_over_pairs(distances: Float[np.ndarray, "B S S"]) -> PerItem:
    """Mean over the pairs of different samples; 0 where there is none."""
    count = distances.shape[1]
    return np.asarray(distances.sum(axis=(1, 2)) / max(count * (count - 1), 1))


def apd_of_largest(samples: Samples, *, pairs: int = 50) -> PerItem:
    """`apd` over the farthest pairs of samples, which Wei et al. 2023 report as the APD.

    Over 50 of the 1225 pairs of 50 samples it is far above `apd`; never compare the two.
    """
    sequences = _root_relative(samples).reshape(len(samples), samples.shape[1], -1)
    first, second = np.triu_indices(samples.shape[1], k=1)
    if not len(first):
        return np.zeros(len(samples))
    distances = np.stack(
        [np.linalg.norm(item[first] - item[second], axis=-1) for item in sequences]
    )
    return np.asarray(np.sort(distances, axis=1)[:, -pairs:].mean(axis=1))


def multimodal_groups(
    last_observed: Float[np.ndarray, "B J 3"], *, threshold: float
) -> Bool[np.ndarray, "B B"]:
    """True at [i, m] where the last observed poses of i and m are closer than threshold metres.

    Every item is in its own group.
    """
    poses = _root_relative(last_observed)
    groups = np.stack([np.linalg.norm(poses - pose, axis=-1) < threshold for pose in poses])
    return groups | np.eye(len(poses), dtype=bool)


def mmade(samples: Samples, futures: Futures, groups: Bool[np.ndarray, "B B"]) -> PerItem:
    """Mean over the futures of an item's group of the `ade` of its samples to that future."""
    return _over_groups(ade, samples, futures, groups)


def mmfde(samples: Samples, futures: Futures, groups: Bool[np.ndarray, "B B"]) -> PerItem:
    """Mean over the futures of an item's group of the `fde` of its samples to that future."""
    return _over_groups(fde, samples, futures, groups)


def motion_per_frame(samples: Samples) -> Float[np.ndarray, "B H-1"]:
    """Metres from each future frame to the next, mean over samples and joints."""
    moved = np.diff(_root_relative(samples), axis=2)  # (B, S, H-1, (J-1)·3)
    steps = np.linalg.norm(moved.reshape(*moved.shape[:3], -1, 3), axis=-1)
    return np.asarray(steps.mean(axis=(1, 3)))


def cmd(
    motion: Float[np.ndarray, "B M"], classes: Sequence[str], class_means: Mapping[str, float]
) -> float:
    """Cumulative motion distribution distance (Barquero et al. 2023): 0 where motion is as real.

    Args:
        motion: `motion_per_frame` of every item.
        classes: the class of every item.
        class_means: mean motion per frame of the real futures of each class.
    """
    names = np.array(classes)
    weights = np.arange(motion.shape[1], 0, -1)  # T - t: an early error stays in all later sums
    total = 0.0
    for name in sorted(set(classes)):
        mine = names == name
        distance = np.abs(motion[mine].mean(axis=0) - class_means[name])
        total += float((weights * distance).sum()) * int(mine.sum())
    return total / len(classes)


def class_means(motion: Float[np.ndarray, "B M"], classes: Sequence[str]) -> dict[str, float]:
    """Mean motion per frame of each class."""
    names = np.array(classes)
    return {name: float(motion[names == name].mean()) for name in sorted(set(classes))}


def bones(parents: Sequence[int]) -> Limbs:
    """Every joint with its parent."""
    return np.array([(joint, parent) for joint, parent in enumerate(parents) if parent >= 0])


def root_free_limbs(parents: Sequence[int]) -> Limbs:
    """The limbs of benchmarks that drop the root: bones elsewhere, and lines between its children.

    Those lines change where hip joints turn about the root, so bones alone tell of stretching.
    """
    below = [joint for joint, parent in enumerate(parents) if parent == 0]
    virtual = [(a, b) for i, a in enumerate(below) for b in below[i + 1 :]]
    kept = [(joint, parent) for joint, parent in enumerate(parents) if parent > 0]
    return np.array(kept + virtual)


def limb_stretch(samples: Samples, future: Futures, limbs: Limbs) -> tuple[PerItem, PerItem]:
    """Mean and RMSE over the frames, in % of the real length, of how far limbs differ from it.

    As the paper defines them (Curreli et al. 2025, eq. 13).
    """
    lengths, real = _limb_lengths(samples, future, limbs)
    error = np.abs(lengths - real[:, :, None]) / real[:, :, None]
    return _percent(error.mean(axis=2)), _percent(np.sqrt(np.square(error).mean(axis=2)))


def mean_length_error(samples: Samples, future: Futures, limbs: Limbs) -> PerItem:
    """How far the mean length of each sample's limbs differs from the real one, in % of it.

    What the authors' published code calls the mean stretch; it does not see a limb that swings
    about its length.
    """
    lengths, real = _limb_lengths(samples, future, limbs)
    return _percent(np.abs(lengths.mean(axis=2) - real) / real)


def limb_jitter(samples: Samples, future: Futures, limbs: Limbs) -> tuple[PerItem, PerItem]:
    """Mean and RMSE, in % of the real length, of how much limbs change from frame to frame.

    Paper (Curreli et al. 2025, eq. 13) and published code agree on these.
    """
    lengths, real = _limb_lengths(samples, future, limbs)
    change = np.diff(lengths, axis=2)
    mean = np.abs(change).mean(axis=2) / real
    rmse = np.sqrt(np.square(change).mean(axis=2)) / real
    return _percent(mean), _percent(rmse)


def worst_limb_errors(
    samples: Samples, future: Futures, limbs: Limbs
) -> tuple[Float[np.ndarray, "B S"], Float[np.ndarray, "B S"]]:
    """The largest stretch and the largest jitter of each sample, in % of the real length."""
    lengths, real = _limb_lengths(samples, future, limbs)
    stretch = np.abs(lengths - real[:, :, None]) / real[:, :, None]
    jitter = np.abs(np.diff(lengths, axis=2)) / real[:, :, None]
    return 100 * stretch.max(axis=(2, 3)), 100 * jitter.max(axis=(2, 3))


def valid_share(worst: Float[np.ndarray, "B S"], tolerance: float) -> PerItem:
    """Share of an item's samples whose largest error is below the tolerance (ibid., Fig. 7)."""
    return np.asarray((worst < tolerance).mean(axis=1))


def valid_apd(
    distances: Float[np.ndarray, "B S S"], worst: Float[np.ndarray, "B S"], tolerance: float
) -> PerItem:
    """`apd` among the samples whose largest error is below the tolerance (ibid., Fig. 8).

    0 where fewer than two are.

    Args:
        distances: `sample_distances`.
        worst: one of `worst_limb_errors`.
        tolerance: in the same %.
    """
    valid = worst < tolerance
    count = valid.sum(axis=1)
    total = (distances * valid[:, :, None] * valid[:, None]).sum(axis=(1, 2))
    return np.asarray(total / np.maximum(count * (count - 1), 1))


def first_frame_jump(samples: Samples, observation: Float[np.ndarray, "B T J 3"]) -> PerItem:
    """Metres that joints move from the last observed frame to the first predicted one, mean."""
    step = samples[:, :, 0] - observation[:, None, -1].astype(np.float64)
    return np.asarray(np.linalg.norm(step, axis=-1).mean(axis=(1, 2)))


def velocity_change(samples: Samples, observation: Float[np.ndarray, "B T J 3"]) -> PerItem:
    """Metres by which joints' first predicted step differs from their last observed one, mean."""
    observed = observation[:, None].astype(np.float64)
    change = samples[:, :, 0] - 2 * observed[:, :, -1] + observed[:, :, -2]
    return np.asarray(np.linalg.norm(change, axis=-1).mean(axis=(1, 2)))


def _flat(poses: Float[np.ndarray, "*batch J 3"]) -> Float[np.ndarray, "*batch F"]:
    return poses.astype(np.float64).reshape(*poses.shape[:-2], -1)


def _root_relative(poses: Float[np.ndarray, "*batch J 3"]) -> Float[np.ndarray, "*batch F"]:
    wide = poses.astype(np.float64)
    return _flat(wide[..., 1:, :] - wide[..., :1, :])


def _errors(
    samples: Float[np.ndarray, "B S H F"], future: Float[np.ndarray, "B H F"]
) -> Float[np.ndarray, "B S H"]:
    return np.asarray(np.linalg.norm(samples - future[:, None], axis=-1))


def _best(errors: Float[np.ndarray, "B S"]) -> PerItem:
    return np.asarray(errors.min(axis=1))


def _over_groups(
    metric: Callable[[Samples, Futures], PerItem],
    samples: Samples,
    futures: Futures,
    groups: Bool[np.ndarray, "B B"],
) -> PerItem:
    means = []
    for item, group in zip(samples, groups, strict=True):  # one pair at a time: groups are large
        errors = [metric(item[None], futures[m, None])[0] for m in np.flatnonzero(group)]
        means.append(np.mean(errors))
    return np.array(means)


def _limb_lengths(
    samples: Samples, future: Futures, limbs: Limbs
) -> tuple[Float[np.ndarray, "B S H kept"], Float[np.ndarray, "B 1 kept"]]:
    """Lengths of every limb, and the real mean length; limbs that have none are left out."""
    ends, starts = limbs.T

    def lengths(poses: np.ndarray) -> np.ndarray:
        wide = poses.astype(np.float64)
        return np.asarray(np.linalg.norm(wide[..., ends, :] - wide[..., starts, :], axis=-1))

    real = lengths(future).mean(axis=1)  # (B, L)
    kept = (real > 1e-6).all(axis=0)
    return lengths(samples)[..., kept], real[:, None, kept]


def _percent(values: Float[np.ndarray, "B S L"]) -> PerItem:
    return np.asarray(100 * values.mean(axis=(1, 2)))
