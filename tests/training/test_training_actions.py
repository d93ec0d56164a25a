"""Rows of labelled actions: which clips they come from, how they are joined, where they end."""

import dataclasses

import numpy as np
import pytest
import torch
from people import walker

from models.motion.kinematics import yaw
from models.motion.skeleton import BODY21, SMPL22
from models.system import Actions, Augmentation, Data
from training.data.action_batches import ActionBatches, mirrored_labels
from training.data.augment import mirror
from training.data.batches import Batches
from training.data.corpora import floor_height
from training.data.store import ClipRecord, Recording, Store, StoreError, open_store, write_store
from training.data.transitions import facing_poses, leg_lengths
from training.loop import batches_of

HORIZON, OBSERVED = 100, 15
PLAIN = Augmentation(mirror=False, yaw=False)
VARIED = Augmentation(
    slowest=0.8, fastest=1.25, body_scale=0.05, bone_scale=0.06, observation_noise=0.008
)
CLIPS = (  # name, action, frames, size of the person, height of the ground, split
    ("a0", "wave-left", 60, 1.0, 0.0, "train"),
    ("a1", "wave-right", 70, 1.1, 0.3, "train"),
    ("a2", "wave-right", 90, 0.9, -0.1, "train"),
    ("a3", "wave-right", 55, 1.0, 0.1, "train"),
    ("a4", "turn-left", 300, 1.0, 0.2, "train"),
    ("a5", "turn-left", 30, 1.05, 0.0, "train"),
    ("a6", "turn-left", 80, 1.0, 0.0, "valid"),
    ("a7", "wave-left", 80, 1.0, 0.0, "test"),
)
LABELS = {name: (f"action={name}",) for name in ("wave-left", "wave-right", "turn-left")}
ACTIONS = Actions(labels=LABELS)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Walkers whose feet leave the ground, of several sizes and on grounds of several heights."""
    clips = []
    for seed, (name, action, frames, size, ground, split) in enumerate(CLIPS):
        positions = size * walker(frames, seed=seed).positions + [2.0 * seed, -seed, ground]
        record = ClipRecord(
            name=name,
            source="walkers",
            split=split,
            start=0,
            length=frames,
            action=action,
            floor=floor_height(positions),
        )
        rest = np.zeros((21, 3))
        clips.append((record, Recording(positions=positions.astype(np.float32), rest_offsets=rest)))
    folder = tmp_path_factory.mktemp("actions") / "store"
    write_store(folder, skeleton=BODY21, fps=30.0, clips=clips, files={})
    return open_store(folder)


def data(**changes: object) -> Data:
    plain = Data(
        skeleton=BODY21,
        fps=30.0,
        num_observed=OBSERVED,
        horizon=HORIZON,
        augmentation=PLAIN,
        actions=ACTIONS,
    )
    return dataclasses.replace(plain, **changes)  # type: ignore[arg-type]


def sharing(other_share: float, **changes: object) -> Data:
    return data(actions=dataclasses.replace(ACTIONS, other_share=other_share), **changes)


def rows_of(batches: ActionBatches, *, count: int = 64, number: int = 0) -> list[dict]:
    batch = batches.batch(number, count)
    return [{key: value[i].numpy() for key, value in batch.items()} for i in range(count)]


def sizeless(poses: np.ndarray) -> np.ndarray:
    """Poses without place, heading and size: what a row keeps of the recording."""
    legs = leg_lengths(poses, BODY21)[..., None, None]
    return np.asarray(facing_poses(poses, BODY21) / legs)


def recorded(store: Store, pose: np.ndarray) -> tuple[ClipRecord, int]:
    """The clip of the store that a pose is from, and its frame there."""
    distances = np.square(sizeless(np.array(store.positions)) - sizeless(pose)).sum(axis=(1, 2))
    frame = int(distances.argmin())
    assert distances[frame] < 1e-6
    [clip] = [c for c in store.clips if c.start <= frame < c.start + c.length]
    return clip, frame - clip.start


def label_of(clip: ClipRecord) -> int:
    return list(LABELS).index(clip.action)


def test_batch_has_what_the_contract_says(store: Store):
    batch = ActionBatches(store, data(augmentation=VARIED), seed=0).batch(0, 8)
    shapes = {name: tuple(tensor.shape) for name, tensor in batch.items()}
    observed = (8, OBSERVED, 21, 3)
    assert shapes == {
        "observation": observed, "seen": observed, "future": (8, HORIZON, 21, 3),
        "action": (8,), "first": (8,), "length": (8,),
    }  # fmt: skip
    assert {batch[name].dtype for name in ("action", "first", "length")} == {torch.int64}
    assert {batch[name].dtype for name in ("observation", "seen", "future")} == {torch.float32}
    assert not torch.equal(batch["seen"], batch["observation"])


def test_batch_is_a_pure_function_of_seed_and_number(store: Store):
    def drawn(seed: int, number: int) -> dict[str, torch.Tensor]:
        batches = ActionBatches(store, data(augmentation=VARIED), seed=seed)
        stream = batches.stream(first=number, size=16)
        batch = next(stream)
        stream.close()
        return batch

    for name, tensor in drawn(1, 5).items():
        assert torch.equal(tensor, drawn(1, 5)[name])
        assert not torch.equal(tensor, drawn(1, 6)[name])
        assert not torch.equal(tensor, drawn(2, 5)[name])


def test_labels_are_drawn_alike_however_many_clips_they_have(store: Store):
    action = ActionBatches(store, data(), seed=0).batch(0, 3000)["action"]
    shares = np.bincount(action.numpy()) / 3000
    np.testing.assert_allclose(shares, 1 / 3, atol=0.03)


def test_row_of_one_clip_is_the_recording_from_its_first_part_to_its_end(store: Store):
    starts = set()
    for row in rows_of(ActionBatches(store, sharing(0.0), seed=0)):
        clip, start = recorded(store, row["observation"][0])
        starts.add((clip.name, start))
        assert start <= max(0.1 * clip.length, 10)
        assert (row["action"], row["first"]) == (label_of(clip), 0)
        assert row["length"] == min(clip.length - start - OBSERVED, HORIZON)
        real = np.array(store.clip_positions(clip)[start : start + OBSERVED + HORIZON])
        real[..., :2] -= real[OBSERVED - 1, 0, :2]
        whole = np.concatenate([row["observation"], row["future"]])
        np.testing.assert_allclose(whole[: len(real)], real, atol=1e-5)
        rest = whole[len(real) :]
        np.testing.assert_array_equal(rest, np.broadcast_to(whole[len(real) - 1], rest.shape))
    assert len(starts) > 20  # places vary
    assert {start for name, start in starts if name == "a5"} == {0}  # it has 30 frames


def test_long_clip_is_cut_at_the_horizon_and_has_no_end(store: Store):
    rows = rows_of(ActionBatches(store, data(), seed=0), count=200)
    long = [row for row in rows if recorded(store, row["future"][-1])[0].name == "a4"]
    assert len(long) > 20
    for row in long:
        assert row["length"] == HORIZON
        assert np.abs(np.diff(row["future"], axis=0)).max(axis=(1, 2))[row["first"] :].min() > 1e-4


def test_other_share_tells_how_many_rows_have_a_transition(store: Store):
    first = ActionBatches(store, sharing(0.25), seed=0).batch(0, 2000)["first"]
    assert (first > 0).float().mean() == pytest.approx(0.25, abs=0.03)


def test_no_row_shows_a_clip_that_is_held_out_or_of_another_split(store: Store):
    held_out = data(hold_out=("name=a2",))
    shown = set()
    for row in rows_of(ActionBatches(store, held_out, seed=0), count=200):
        poses = (row["observation"][0], row["observation"][-1], row["future"][row["first"]])
        shown |= {recorded(store, pose)[0].name for pose in poses}
    assert shown == {"a0", "a1", "a3", "a4", "a5"}


def test_transition_comes_from_another_action_and_enters_where_the_pose_is_nearest(store: Store):
    batches = ActionBatches(store, sharing(1.0), seed=0)
    longest, seen_lengths = ACTIONS.longest_transition, set()
    for row in rows_of(batches):
        first, last = row["first"], row["observation"][-1]
        seen, _ = recorded(store, last)
        target, entry = recorded(store, row["future"][first])
        assert row["action"] == label_of(target) != label_of(seen)
        leg = float(leg_lengths(last, BODY21))
        part = int(min(max(0.1 * target.length, 15), target.length - ACTIONS.min_frames + 1))
        entries = np.array(store.clip_positions(target)[:part])
        distances = [np.linalg.norm(sizeless(e) - sizeless(last)) * leg for e in entries]
        assert entry == np.argmin(distances)
        way = batches.frames_per_metre * min(distances)
        assert abs(first - min(int(way) + 1, longest)) <= (min(way % 1, 1 - way % 1) < 1e-3)
        seen_lengths.add(int(first))
        assert row["length"] == min(first + target.length - entry, HORIZON)
        before = row["future"][:first]
        np.testing.assert_array_equal(before, np.broadcast_to(row["future"][first], before.shape))
        after = row["future"][row["length"] :]
        end = row["future"][row["length"] - 1]
        np.testing.assert_array_equal(after, np.broadcast_to(end, after.shape))
    assert len(seen_lengths) > 3


def test_other_person_has_the_size_the_ground_and_the_heading_of_the_one_seen(store: Store):
    feet = [BODY21.index(f"{side}_{j}") for side in ("left", "right") for j in ("foot", "toes")]
    for row in rows_of(ActionBatches(store, sharing(1.0), seed=0)):
        last, begins = row["observation"][-1], row["future"][row["first"]]
        legs = leg_lengths(row["future"], BODY21)
        np.testing.assert_allclose(legs, leg_lengths(last, BODY21), rtol=1e-4)
        assert np.cos(yaw(last, BODY21) - yaw(begins, BODY21)) == pytest.approx(1.0, abs=1e-5)
        seen, _ = recorded(store, last)
        target, entry = recorded(store, begins)
        scale = legs[0] / leg_lengths(store.clip_positions(target)[0], BODY21)
        played = store.clip_positions(target)[entry : entry + row["length"] - row["first"]]
        above = scale * (played[:, feet, 2] - target.floor)
        found = row["future"][row["first"] : row["length"]][:, feet, 2] - seen.floor
        np.testing.assert_allclose(found, above, atol=1e-4)


def test_no_one_is_moved_faster_over_a_transition_than_they_walk(store: Store):
    for row in rows_of(ActionBatches(store, sharing(1.0), seed=0)):
        first, path = row["first"], row["future"][:, 0, :2]
        mean_step = np.linalg.norm(path[first] - row["observation"][-1, 0, :2]) / (first + 1)
        around = np.diff(row["observation"][:, 0, :2], axis=0)[-1], path[first + 1] - path[first]
        assert mean_step <= max(np.linalg.norm(step) for step in around) + 1e-5


def test_about_half_of_the_others_stand_at_the_end_of_what_they_did(store: Store):
    stands = []
    for row in rows_of(ActionBatches(store, sharing(1.0), seed=0), count=300):
        seen, frame = recorded(store, row["observation"][-1])
        repeats = int((np.diff(row["observation"], axis=0) == 0).all(axis=(1, 2)).sum())
        assert repeats <= 10
        assert repeats == 0 or frame == seen.length - 1
        stands.append(repeats > 0)
    assert np.mean(stands) == pytest.approx(0.5 * 10 / 11, abs=0.08)


def test_rate_varies_the_duration(store: Store):
    how = dataclasses.replace(PLAIN, slowest=0.8, fastest=1.25)
    one = {"actions": Actions(labels={"wave-left": ("name=a0",)}, other_share=0.0)}
    length = ActionBatches(store, data(augmentation=how, **one), seed=0).batch(0, 300)["length"]
    assert length.min() < 0.75 * 45
    assert length.max() > 1.15 * 45
    assert length.min() >= ACTIONS.min_frames


def test_short_clip_that_is_played_fast_still_has_its_least_frames(store: Store):
    how = dataclasses.replace(PLAIN, slowest=1.0, fastest=1.5)
    one = {"actions": Actions(labels={"short": ("name=a5",)}, other_share=0.0)}
    length = ActionBatches(store, data(augmentation=how, **one), seed=0).batch(0, 50)["length"]
    assert length.unique().tolist() == [ACTIONS.min_frames]


def test_labels_of_mirror_images():
    labels = ("walk", "wave-left-hand", "wave-right-hand", "left-turn", "leftover")
    assert mirrored_labels(labels).tolist() == [0, 2, 1, -1, 4]


def test_mirrored_row_has_the_label_of_the_other_side_or_stays(store: Store):
    kept = {name: 0 for name in LABELS}
    exchanged = dict(kept)
    how = Augmentation(yaw=False)
    for row in rows_of(ActionBatches(store, sharing(0.0, augmentation=how), seed=0), count=200):
        poses = np.stack(
            [row["observation"][0], mirror(row["observation"][:1, None], BODY21)[0, 0]]
        )
        distances = [
            np.square(sizeless(np.array(store.positions)) - sizeless(pose)).sum(axis=(1, 2)).min()
            for pose in poses
        ]
        clip, _ = recorded(store, poses[np.argmin(distances)])
        name = list(LABELS)[row["action"]]
        if np.argmin(distances) == 0:
            assert name == clip.action
            kept[name] += 1
        else:
            assert {name, clip.action} == {"wave-left", "wave-right"}
            exchanged[name] += 1
    assert exchanged["turn-left"] == 0
    assert min(*kept.values(), exchanged["wave-left"], exchanged["wave-right"]) > 15


def test_loop_learns_actions_where_a_recipe_has_some(store: Store):
    assert isinstance(batches_of(store, data(), seed=0), ActionBatches)
    assert isinstance(batches_of(store, data(actions=None), seed=0), Batches)


def test_label_without_a_clip_is_an_error_that_names_it(store: Store):
    jump = dataclasses.replace(ACTIONS, labels={**LABELS, "jump": ("action=jump",)})
    with pytest.raises(StoreError, match=r"labels\['jump'\]: found no training clip of 30 frames"):
        ActionBatches(store, data(actions=jump), seed=0)
    held_out = data(hold_out=("action=wave-left",))
    with pytest.raises(StoreError, match=r"labels\['wave-left'\]"):
        ActionBatches(store, held_out, seed=0)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"actions": None}, "no labels"),
        ({"actions": Actions(labels={})}, "no labels"),
        ({"actions": Actions(labels={"walk": ("all",)})}, "found 0.5 with one label"),
        ({"horizon": 26}, "found 26 frames; it must be longer"),
        ({"skeleton": SMPL22}, "the recipe needs smpl22"),
    ],
)
def test_recipe_whose_rows_cannot_be_made_is_refused(store: Store, changes: dict, says: str):
    with pytest.raises(StoreError, match=says):
        ActionBatches(store, data(**changes), seed=0)
