"""Loss terms of several systems."""

from jaxtyping import Float
from torch import Tensor


def motion_distance(difference: Float[Tensor, "*B H F"]) -> Float[Tensor, "*B"]:
    """Distance of two motions by their difference: poses as vectors, mean over the frames.

    It has a gradient where they are equal, too.
    """
    return (difference.square().sum(dim=-1) + 1e-8).sqrt().mean(dim=-1)
