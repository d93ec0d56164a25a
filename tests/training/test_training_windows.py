"""Windows, and which of them a recipe may draw."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from people import small_store

from models.motion.skeleton import BODY21, SMPL22
from models.system import Augmentation, Data
from training.data.batches import Batches, training_clips
from training.data.store import Store, StoreError, open_store, select
from training.data.windows import Windows, cut

PLAIN = Augmentation(mirror=False, yaw=False)
VARIED = Augmentation(
    slowest=0.8, fastest=1.25, body_scale=0.05, bone_scale=0.06, observation_noise=0.008
)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("small") / "store")


def data(**changes: object) -> Data:
    plain = Data(skeleton=BODY21, fps=30.0, num_observed=15, horizon=60, augmentation=PLAIN)
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def row_of(store: Store, observation: torch.Tensor) -> int:
    """The frame of the store where an observation starts; windows are moved to the origin."""
    shape = np.asarray(store.positions) - np.asarray(store.positions)[:, :1]
    wanted = (observation - observation[:, :1])[0].numpy()
    return int(np.square(shape - wanted).sum(axis=(1, 2)).argmin())


def test_windows_are_all_that_fit_into_a_clip_and_cross_no_end(store: Store):
    windows = Windows.of(store.clips, num_frames=75)
    assert len(windows) == sum(clip.length - 74 for clip in store.clips)
    for start, room, index in zip(windows.starts, windows.room, windows.clip_index, strict=True):
        clip = store.clips[index]
        assert clip.start <= start
        assert start + 75 <= start + room == clip.start + clip.length


def test_stride_keeps_every_nth_window_of_each_clip(store: Store):
    windows = Windows.of(store.clips, num_frames=75, stride=10)
    first = [windows.starts[windows.clip_index == i][0] for i in range(len(store.clips))]
    assert first == [clip.start for clip in store.clips]
    assert set(np.diff(windows.starts[windows.clip_index == 3])) == {10}


def test_cut_gives_the_frames_as_recorded(store: Store):
    windows = Windows.of(store.clips[2:3], num_frames=75, stride=7)
    poses = cut(store, windows, num_frames=75, indices=np.array([2]))
    np.testing.assert_array_equal(poses[0], store.clip_positions(store.clips[2])[14:89])


def test_shares_decide_how_often_a_source_is_drawn(store: Store):
    windows = Windows.of(store.clips, num_frames=75, shares={"left": 0.9, "right": 0.1})
    drawn = windows.draw(4000, np.random.default_rng(0))
    left = np.array([clip.source.startswith("left") for clip in store.clips])
    assert left[windows.clip_index[drawn]].mean() == pytest.approx(0.9, abs=0.02)


def test_a_source_without_a_share_is_an_error(store: Store):
    with pytest.raises(StoreError, match="no share is given for the source right-0"):
        Windows.of(store.clips, num_frames=75, shares={"left": 1.0})


def test_clips_that_are_all_too_short_are_an_error(store: Store):
    with pytest.raises(StoreError, match=r"none of the 6 selected clips has 500 frames\."):
        Windows.of(store.clips, num_frames=500)


def test_held_out_clips_and_other_splits_are_no_training_clips(store: Store):
    chosen = training_clips(store, data(hold_out=("style=old", "subject=3")))
    assert [clip.name for clip in chosen] == ["take1", "take2", "take4"]
    only = training_clips(store, data(shares={"left": 1.0}))
    assert [clip.name for clip in only] == ["take1", "take3"]


def test_held_out_clips_are_never_drawn(store: Store):
    batches = Batches(store, data(hold_out=("action=action1",)), seed=0)
    held_out = [c for c in store.clips if c.action == "action1" or c.split == "valid"]
    forbidden = np.concatenate([np.arange(c.start, c.start + c.length) for c in held_out])
    for number in range(3):
        for observation in batches.batch(number, 16)["observation"]:
            assert row_of(store, observation) not in forbidden


def test_batch_is_a_pure_function_of_seed_and_number(store: Store):
    def drawn(seed: int, number: int) -> dict[str, torch.Tensor]:
        return Batches(store, data(augmentation=VARIED), seed=seed).batch(number, 8)

    for name, tensor in drawn(1, 5).items():
        assert torch.equal(tensor, drawn(1, 5)[name])
        assert not torch.equal(tensor, drawn(1, 6)[name])
        assert not torch.equal(tensor, drawn(2, 5)[name])


def test_stream_continues_where_it_is_told_to(store: Store):
    batches = Batches(store, data(augmentation=VARIED), seed=1)
    stream = batches.stream(first=3, size=4)
    for number in (3, 4, 5):
        for name, tensor in next(stream).items():
            assert torch.equal(tensor, batches.batch(number, 4)[name])
    stream.close()  # type: ignore[attr-defined]  # a generator


def test_batch_without_variation_is_the_recording_moved_to_the_origin(store: Store):
    batch = Batches(store, data(), seed=0).batch(0, 8)
    for observation, seen, future in zip(
        batch["observation"], batch["seen"], batch["future"], strict=True
    ):
        start = row_of(store, observation)
        real = np.array(store.positions[start : start + 75])
        real[..., :2] -= real[14, 0, :2]
        np.testing.assert_allclose(np.concatenate([observation, future]), real, atol=1e-5)
        assert torch.equal(seen, observation)


def test_sensor_noise_is_on_what_is_seen_alone(store: Store):
    clean = Batches(store, data(), seed=0).batch(0, 64)
    noisy = Batches(
        store, data(augmentation=dataclasses.replace(PLAIN, observation_noise=0.01)), seed=0
    ).batch(0, 64)
    assert torch.equal(clean["observation"], noisy["observation"])
    assert torch.equal(clean["future"], noisy["future"])
    spread = (noisy["seen"] - noisy["observation"]).flatten(1).std(dim=1)
    assert 16 < int((spread > 0).sum()) < 48
    torch.testing.assert_close(
        spread[spread > 0], torch.full_like(spread[spread > 0], 0.01), atol=1e-3, rtol=0
    )


def test_recipe_for_another_skeleton_or_rate_is_refused(store: Store):
    with pytest.raises(StoreError, match=r"found body21 at 30\.0 fps; the recipe needs smpl22"):
        Batches(store, data(skeleton=SMPL22), seed=0)
    with pytest.raises(StoreError, match=r"the recipe needs body21 at 50\.0 fps"):
        Batches(store, data(fps=50.0), seed=0)


def test_selectors_join_by_and_within_and_by_or_between(store: Store):
    both = select(store.clips, ("style=young&action=action0", "subject=5"))
    assert [clip.name for clip in both] == ["take3", "take5"]
    assert len(select(store.clips, ("source=left*",))) == 3
    assert select(store.clips, ("all",)) == store.clips
    assert select(store.clips, ()) == ()


@pytest.mark.parametrize("wrong", ["old", "age=7", "style="])
def test_a_selector_that_says_nothing_is_an_error(store: Store, wrong: str):
    with pytest.raises(StoreError, match="must be field=value"):
        select(store.clips, (wrong,))


def test_an_incomplete_store_is_an_error(tmp_path: Path):
    with pytest.raises(StoreError, match=r"found no clips\.json"):
        open_store(tmp_path)
    small_store(tmp_path / "store", num_clips=1)
    np.save(tmp_path / "store" / "positions.npy", np.zeros((5, 21, 3), np.float32))
    with pytest.raises(StoreError, match="found 5 frames"):
        open_store(tmp_path / "store")
