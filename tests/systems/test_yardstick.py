"""The yardstick's own rules; what every system must pass is in test_systems.py."""

import pytest
import torch

from models.systems.yardstick.networks import Yardstick, best_of_many_loss
from models.systems.yardstick.recipes import tiny


@pytest.fixture
def network() -> Yardstick:
    return tiny().build()


@pytest.fixture
def batch() -> dict[str, torch.Tensor]:
    drawn = torch.Generator().manual_seed(1)
    data = tiny().data
    pose = torch.rand((6, 1, data.skeleton.num_joints, 3), generator=drawn)
    steps = torch.randn((6, data.num_observed + data.horizon, 1, 3), generator=drawn) / 100
    poses = pose + steps.cumsum(dim=1)
    observation = poses[:, : data.num_observed]
    return {
        "observation": observation,
        "seen": observation,
        "future": poses[:, data.num_observed :],
    }


def test_only_the_nearest_of_the_candidates_counts(network, batch):
    with torch.no_grad():
        network.add_noise.weight.mul_(20)  # candidates that bfloat16 can tell apart
        loss = best_of_many_loss(network, batch, torch.Generator().manual_seed(2), num_candidates=5)
        noise = torch.randn((6, 5, 4), generator=torch.Generator().manual_seed(2))
        nearest = []
        for row in range(6):
            observation, future = batch["observation"][row : row + 1], batch["future"][row]
            enter = network.representation.enter
            context = network.context(enter(observation, observation))
            last = enter(observation, observation[:, -1:])[:, 0]
            wanted = enter(observation, future[None])[0]
            distances = [
                (network.future(one[None], context, last)[0] - wanted).norm(dim=1).mean()
                for one in noise[row]
            ]
            nearest.append(min(distances))
    assert float(loss["total"]) == pytest.approx(float(torch.stack(nearest).mean()), rel=0.01)


def test_future_without_a_spectrum_is_the_last_pose(network, batch):
    with torch.no_grad():
        for parameter in network.network[-1].parameters():
            parameter.zero_()
    enter = network.representation.enter
    observed = enter(batch["observation"], batch["observation"])
    future = network.future(torch.randn(6, 4), network.context(observed), observed[:, -1])
    assert torch.equal(future, observed[:, -1:].expand_as(future))
