"""Representative futures of many, each with the share of the futures that it stands for."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

MICROMETRES = 1e6

Distances = Int[np.ndarray, "N N"]
Medoids = Int[np.ndarray, "K"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Mode:
    """A future that stands for others: its sample, and all ``members``, itself included."""

    probability: float
    sample: int
    members: tuple[int, ...]


def modes(futures: Float[np.ndarray, "N H J 3"], *, num_modes: int) -> tuple[Mode, ...]:
    """The likeliest first; as many as asked for, or one for each future where there are fewer.

    k-medoids under `distances_um` (PAM: Kaufman and Rousseeuw 1990), in whole numbers and without
    a draw, so that equal futures have equal modes. Probabilities sum to 1.
    """
    distances = distances_um(futures)
    medoids = np.sort(_swapped(distances, _built(distances, min(num_modes, len(futures)))))
    nearest = distances[:, medoids].argmin(axis=1)
    nearest[medoids] = np.arange(len(medoids))  # a medoid is its own, even beside its double
    found = [
        _mode(int(medoid), np.flatnonzero(nearest == index), len(futures))
        for index, medoid in enumerate(medoids)
    ]
    return tuple(sorted(found, key=lambda mode: (-len(mode.members), mode.sample)))


def distances_um(futures: Float[np.ndarray, "N H J 3"]) -> Distances:
    """Micrometres between futures: the mean over frames of the RMS distance of the joints."""
    count, num_frames, num_joints, _ = futures.shape
    poses = futures.astype(np.float64).reshape(count, num_frames, -1).swapaxes(0, 1)
    poses -= poses.mean(axis=1, keepdims=True)  # near 0, where products keep their digits
    products = poses @ poses.swapaxes(1, 2)  # (H, N, N)
    squares = np.diagonal(products, axis1=1, axis2=2)
    apart = np.maximum(squares[:, :, None] + squares[:, None] - 2 * products, 0.0)
    metres = np.sqrt(apart / num_joints).mean(axis=0)
    whole: np.ndarray = np.rint(MICROMETRES * (metres + metres.T) / 2).astype(np.int64)
    np.fill_diagonal(whole, 0)
    return whole


def _mode(sample: int, members: Int[np.ndarray, "_"], count: int) -> Mode:
    return Mode(probability=len(members) / count, sample=sample, members=tuple(map(int, members)))


def _built(distances: Distances, num_modes: int) -> Medoids:
    """Medoids one by one, each the one that then costs least (the BUILD of PAM)."""
    medoids: list[int] = []
    nearest = np.full(len(distances), distances.max() + 1)
    for _ in range(num_modes):
        costs = np.minimum(distances, nearest[:, None]).sum(axis=0)
        costs[medoids] = np.iinfo(np.int64).max
        medoids.append(int(costs.argmin()))
        nearest = np.minimum(nearest, distances[:, medoids[-1]])
    return np.array(medoids)


def _swapped(distances: Distances, medoids: Medoids) -> Medoids:
    """Medoids such that no exchange of one for another future costs less (the SWAP of PAM)."""
    count = len(medoids)
    never = np.full((len(distances), 1), distances.max() + 1)
    while True:
        mine = np.concatenate([distances[:, medoids], never], axis=1)
        order = mine.argsort(axis=1, kind="stable")[:, :2]
        first, second = np.take_along_axis(mine, order, axis=1).T
        kept = np.minimum(distances, first[:, None])
        without = np.minimum(distances, second[:, None]) - kept
        owned = (order[:, 0] == np.arange(count)[:, None]).astype(np.int64)  # (K, N)
        costs = kept.sum(axis=0) + owned @ without  # [k, n]: n in the place of medoid k
        out, into = np.unravel_index(costs.argmin(), costs.shape)
        if costs[out, into] >= first.sum():
            return medoids
        medoids = np.where(np.arange(count) == out, into, medoids)
