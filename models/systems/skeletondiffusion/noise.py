"""Noise that follows the skeleton: node types, correlation and the nonisotropic schedule."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from models.diffusion import Schedule
from models.motion.skeleton import Skeleton

SMALLEST_EIGENVALUE = 0.05


@dataclass(frozen=True, kw_only=True, slots=True)
class NodeGraph:
    """The graph whose nodes carry the latents.

    Args:
        types: for each node its type; a left joint and its right one share one.
        edges: pairs of nodes that a limb connects.
    """

    types: tuple[int, ...]
    edges: tuple[tuple[int, int], ...]

    @property
    def num_nodes(self) -> int:
        """N, the number of nodes."""
        return len(self.types)

    @property
    def num_types(self) -> int:
        """The number of different types."""
        return max(self.types) + 1

    @property
    def adjacency(self) -> Float[np.ndarray, "N N"]:
        """1 where a limb connects two nodes, without loops."""
        matrix = np.zeros((self.num_nodes, self.num_nodes))
        for one, other in self.edges:
            matrix[one, other] = matrix[other, one] = 1.0
        return matrix

    @property
    def correlation(self) -> Float[np.ndarray, "N N"]:
        """Sigma_N (eq. 4): the adjacency, shifted and divided so that its spectrum is [0, 1].

        The smallest eigenvalue is 0 by construction, and a direction without noise cannot be
        denoised: eigenvalues below `SMALLEST_EIGENVALUE` are raised to it, vectors kept.
        """
        values, vectors = np.linalg.eigh(self.adjacency)
        spectrum = (values - values[0]) / (values[-1] - values[0])
        floored: Float[np.ndarray, "N N"]
        floored = vectors * np.maximum(spectrum, SMALLEST_EIGENVALUE) @ vectors.T
        return floored

    def eigen(self) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N N"]]:
        """Eigenvalues Lambda_N of the correlation, rising, and eigenvectors U as columns."""
        values, vectors = np.linalg.eigh(self.correlation)
        return values, vectors


def with_root(skeleton: Skeleton) -> NodeGraph:
    """Every joint a node, the root too, which carries the trajectory; limbs are the edges."""
    pairs = enumerate(skeleton.parents)
    return NodeGraph(
        types=_types(range(skeleton.num_joints), skeleton.mirror),
        edges=tuple((parent, child) for child, parent in pairs if parent >= 0),
    )


def without_root(skeleton: Skeleton) -> NodeGraph:
    """The joints below the root; those that hang from it are connected with each other."""
    kept = range(1, skeleton.num_joints)
    below = [child - 1 for child in skeleton.children[0]]
    limbs = [(skeleton.parents[child] - 1, child - 1) for child in kept if skeleton.parents[child]]
    around = [(one, other) for i, one in enumerate(below) for other in below[i + 1 :]]
    return NodeGraph(types=_types(kept, skeleton.mirror), edges=(*limbs, *around))


def _types(joints: Sequence[int], mirror: Sequence[int]) -> tuple[int, ...]:
    first = [min(joint, mirror[joint]) for joint in joints]
    order = sorted(set(first))
    return tuple(order.index(joint) for joint in first)


def falling(u: float) -> float:
    """gamma_t = 1 - t / T: noise of the skeleton's shape first, isotropic at the end (eq. 5)."""
    return 1.0 - u


def constant(u: float) -> float:
    """gamma_t = 1: noise of the skeleton's shape throughout (eq. 42)."""
    del u
    return 1.0


def nonisotropic(
    alpha_bar: Float[np.ndarray, "K"],
    eigenvalues: Float[np.ndarray, "N"],
    *,
    gamma: Callable[[float], float] = falling,
) -> Schedule:
    """The schedule of eqs. 5 and 6 in the eigenbasis of the correlation.

    variance_t = gamma~_t (Lambda_N - 1) + 1 - alpha_bar_t with
    gamma~_t = (1 - alpha_t) gamma(t / K) + alpha_t gamma~_{t-1} (eqs. 17 and 18).
    """
    num_steps = len(alpha_bar)
    alpha = alpha_bar / np.concatenate([[1.0], alpha_bar[:-1]])
    shaped = np.zeros(num_steps)
    before = 0.0
    for t in range(num_steps):
        before = (1 - alpha[t]) * gamma(t / num_steps) + alpha[t] * before
        shaped[t] = before
    variance = shaped[:, None] * (eigenvalues - 1.0) + (1.0 - alpha_bar)[:, None]
    return Schedule(alpha_bar=alpha_bar, variance=variance)
