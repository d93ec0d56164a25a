"""Fréchet inception distance: how far two sets of features are apart, as two Gaussians."""

import numpy as np
from jaxtyping import Float

Features = Float[np.ndarray, "_ F"]


def fid(first: Features, second: Features) -> float:
    """Fréchet distance of the Gaussians with the two sets' means and covariances, in float64.

    (Heusel et al. 2017; Mao et al. 2022, Eq. 9.) The code that came with the latter takes the
    un-centred second moment in place of the covariance, so its figures cannot be compared.
    """
    a, b = first.astype(np.float64), second.astype(np.float64)
    apart = a.mean(axis=0) - b.mean(axis=0)
    covariance_a, covariance_b = (np.atleast_2d(np.cov(x, rowvar=False)) for x in (a, b))
    root = _square_root(covariance_a)
    # The product of the two is similar to this symmetric matrix, so their roots have one trace.
    eigenvalues = np.linalg.eigvalsh(root @ covariance_b @ root)
    shared = np.sqrt(eigenvalues.clip(min=0.0)).sum()
    spread = np.trace(covariance_a) + np.trace(covariance_b) - 2 * shared
    return float(max(0.0, apart @ apart + spread))  # 0 up to rounding is 0


def _square_root(covariance: Float[np.ndarray, "F F"]) -> Float[np.ndarray, "F F"]:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray((vectors * np.sqrt(values.clip(min=0.0))) @ vectors.T)
