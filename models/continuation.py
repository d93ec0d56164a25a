"""Where the last observed frames point, and the basis in which futures deviate from there."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.pose import continuation_basis


class Continuation(nn.Module):
    """Where the last observed frames point, and the basis in which futures deviate from there.

    The expectation is one linear filter per feature, fitted by least squares; the basis is zero
    at the last observed frame. So whatever the spectrum, a future starts at the last pose with
    the last velocity.
    """

    basis: Tensor
    filter: Tensor

    def __init__(self, *, features: int, num_target: int, horizon: int, bases: int) -> None:
        super().__init__()
        self.bases = bases
        self.register_buffer("basis", continuation_basis(bases, horizon), persistent=False)
        self.register_buffer("filter", torch.zeros(features, horizon, num_target - 1))

    def expected(self, target: Float[Tensor, "B C F"]) -> Float[Tensor, "B H F"]:
        """The future if nothing but the last frames counted."""
        steps = (target[:, :-1] - target[:, -1:]).permute(2, 1, 0)  # (F, C - 1, B)
        return target[:, -1:] + torch.matmul(self.filter, steps).permute(2, 1, 0)

    def spectrum(
        self, target: Float[Tensor, "B C F"], future: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B KF"]:
        """Coefficients of what sets the future apart from the expected one."""
        return torch.matmul(self.basis.T, future - self.expected(target)).flatten(1)

    def frames(
        self, spectrum: Float[Tensor, "B KF"], expected: Float[Tensor, "B H F"]
    ) -> Float[Tensor, "B H F"]:
        """The future that deviates from the expected one by a spectrum."""
        return expected + torch.matmul(self.basis, spectrum.unflatten(1, (self.bases, -1)))

    @torch.no_grad()
    def fit(
        self, target: Float[Tensor, "B C F"], future: Float[Tensor, "B H F"], *, noise_m: float
    ) -> None:
        """Set the filter to the least squares of some motions, bearing noise_m of sensor noise."""
        steps = (target[:, :-1] - target[:, -1:]).permute(2, 0, 1).double()  # (F, B, C - 1)
        moved = (future - target[:, -1:]).permute(2, 0, 1).double()
        # Noise of every frame, that of the last one shared by all steps.
        ridge = len(target) * noise_m**2 * (torch.eye(steps.shape[2]).to(steps) + 1)
        filter_t = torch.linalg.solve(steps.mT @ steps + ridge, steps.mT @ moved)
        self.filter.copy_(filter_t.mT)
