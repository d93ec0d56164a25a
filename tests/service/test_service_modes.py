"""Modes: k-medoids on futures, exact and the same every time."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from service.answers.modes import Mode, distances_um, modes


def some_futures(seed: int, count: int, *, kinds: int | None = None) -> np.ndarray:
    """(N, 4, 3, 3) metres; of ``kinds`` different ones, some come more than once."""
    generator = np.random.default_rng(seed)
    different = generator.normal(size=(kinds or count, 4, 3, 3)).cumsum(axis=1)
    chosen = generator.integers(len(different), size=count) if kinds else np.arange(count)
    return 100.0 + different[chosen].astype(np.float32)


def cost(distances: np.ndarray, medoids: list[int]) -> int:
    return int(distances[:, medoids].min(axis=1).sum())


futures_of_some_kinds = st.builds(
    some_futures,
    seed=st.integers(0, 2**16),
    count=st.integers(1, 14),
    kinds=st.one_of(st.none(), st.integers(1, 5)),
)


@settings(max_examples=150)
@given(futures=futures_of_some_kinds, num_modes=st.integers(1, 16))
def test_modes_share_out_all_futures_and_no_swap_is_better(futures: np.ndarray, num_modes: int):
    found = modes(futures, num_modes=num_modes)
    assert len(found) == min(num_modes, len(futures))
    assert sorted(i for mode in found for i in mode.members) == list(range(len(futures)))
    assert all(mode.sample in mode.members for mode in found)
    np.testing.assert_allclose(sum(mode.probability for mode in found), 1.0, atol=1e-12)
    assert [mode.probability for mode in found] == [
        len(mode.members) / len(futures) for mode in found
    ]
    order = [(-mode.probability, mode.sample) for mode in found]
    assert order == sorted(order)

    distances = distances_um(futures)
    medoids = [mode.sample for mode in found]
    for mode in found:
        for member in mode.members:
            assert distances[member, mode.sample] == distances[member, medoids].min()
    best = cost(distances, medoids)
    for position in range(len(medoids)):
        for other in range(len(futures)):
            swapped = [*medoids[:position], other, *medoids[position + 1 :]]
            assert cost(distances, swapped) >= best


@settings(max_examples=40)
@given(futures=futures_of_some_kinds, num_modes=st.integers(1, 6))
def test_modes_are_the_same_again_and_wherever_the_world_begins(futures, num_modes):
    found = modes(futures, num_modes=num_modes)
    assert modes(futures.copy(), num_modes=num_modes) == found
    assert modes(futures + np.float32(2**-3), num_modes=num_modes) == found


@settings(max_examples=40)
@given(futures=futures_of_some_kinds)
def test_as_many_modes_as_futures_are_the_futures(futures: np.ndarray):
    count = len(futures)
    assert modes(futures, num_modes=count) == tuple(
        Mode(probability=1 / count, sample=i, members=(i,)) for i in range(count)
    )


def test_distance_is_the_mean_over_frames_of_the_rms_of_joints():
    futures = some_futures(3, 6)
    wanted = [
        [
            np.mean(
                [np.sqrt(np.mean(np.sum((p - q) ** 2, axis=-1))) for p, q in zip(a, b, strict=True)]
            )
            for b in futures.astype(float)
        ]
        for a in futures.astype(float)
    ]
    np.testing.assert_allclose(distances_um(futures), 1e6 * np.array(wanted), atol=0.6)


def test_groups_that_lie_apart_are_the_modes():
    generator = np.random.default_rng(0)
    kinds = np.array([0] * 5 + [1] * 3 + [2] * 2)
    goals = np.array([0.0, 4.0, 9.0])[kinds]
    futures = goals[:, None, None, None] + generator.normal(scale=0.1, size=(10, 6, 21, 3))
    found = modes(futures, num_modes=3)
    assert [mode.probability for mode in found] == [0.5, 0.3, 0.2]
    assert [mode.members for mode in found] == [(0, 1, 2, 3, 4), (5, 6, 7), (8, 9)]


def test_the_one_mode_of_all_is_the_future_nearest_to_them_all():
    futures = some_futures(5, 200)
    (mode,) = modes(futures, num_modes=1)
    assert mode.sample == distances_um(futures).sum(axis=0).argmin()
    assert mode.probability == 1.0
