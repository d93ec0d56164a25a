"""From files to a store."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from people import walker, write_small_archive, write_walkers

from models.motion.formats.bvh import write_bvh
from models.motion.formats.npz import clip_of, write_archive
from models.motion.skeleton import H36M17
from training.data.corpora import GlitchLimits, split_of, take_fields
from training.data.glitches import clean_parts, glitch_steps
from training.data.prepare import PrepareError, Report, prepare
from training.data.store import ROTATIONS_FILE, StoreError, open_store

SAMPLES = Path(__file__).parents[3] / "shared" / "data" / "samples"


def reasons(report: Report) -> dict[str, str]:
    return {loss.name: loss.reason for loss in report.dropped}


def test_folder_of_bvh_becomes_a_store_at_its_rate(tmp_path: Path):
    source = write_walkers(tmp_path / "bvh", {"05_02": 1, "dataset-2_run_active_036": 2})
    report = prepare([source], tmp_path / "store")
    store = open_store(tmp_path / "store")
    assert [(c.name, c.source, c.subject, c.action, c.style) for c in store.clips] == [
        ("05_02", "cmu-bvh", "05", "", ""),
        ("dataset-2_run_active_036", "bandai-2", "", "run", "active"),
    ]
    assert [c.length for c in store.clips] == [60, 60]
    assert report.dropped == ()
    real = walker(120, seed=1, fps=60.0).positions[::2]
    np.testing.assert_allclose(store.clip_positions(store.clips[0]), real, atol=2e-4)


def test_a_cut_file_is_reported_and_the_rest_is_kept(tmp_path: Path):
    source = write_walkers(tmp_path / "bvh", {"05_02": 1, "05_03": 2})
    text = (source / "05_03.bvh").read_text()
    (source / "05_03.bvh").write_text(text[: len(text) // 2])
    report = prepare([source], tmp_path / "store")
    assert reasons(report) == {"05_03.bvh": "unreadable"}
    assert [c.name for c in report.kept] == ["05_02"]
    assert "05_03.bvh:" in report.table()
    written = json.loads((tmp_path / "store" / "report.json").read_text())
    assert written["dropped"][0]["detail"] == report.dropped[0].detail
    assert "\n" not in report.dropped[0].detail


def test_archive_keeps_what_it_says_of_its_clips(tmp_path: Path):
    clip = clip_of(walker(90), split="valid", action="walk", subject="07")
    write_archive(tmp_path / "people.npz", [clip])
    prepare([tmp_path / "people.npz"], tmp_path / "store")
    store = open_store(tmp_path / "store")
    record = store.clips[0]
    assert (record.split, record.action, record.subject) == ("valid", "walk", "07")
    assert record.floor == pytest.approx(clip.floor)
    np.testing.assert_array_equal(store.positions, clip.motion.positions)
    rotations = np.load(tmp_path / "store" / ROTATIONS_FILE)
    np.testing.assert_array_equal(rotations, clip.rotations)


def test_rotations_are_left_out_where_a_clip_has_none(tmp_path: Path):
    write_small_archive(tmp_path / "people.npz")
    prepare([tmp_path / "people.npz"], tmp_path / "store", skeleton=H36M17)
    assert open_store(tmp_path / "store").positions.shape[1:] == (17, 3)
    assert not (tmp_path / "store" / ROTATIONS_FILE).exists()


def test_short_take_is_dropped(tmp_path: Path):
    source = write_walkers(tmp_path / "bvh", {"05_02": 1})
    write_bvh(source / "05_03.bvh", walker(20, seed=3, name="05_03"))
    assert reasons(prepare([source], tmp_path / "store")) == {"05_03": "too short"}


def test_take_is_cut_at_a_glitch_and_its_parts_share_a_split(tmp_path: Path):
    motion = walker(120, seed=4, name="05_04")
    motion.positions[70:] += [3.0, 0.0, 0.0]
    write_bvh(tmp_path / "05_04.bvh", motion)
    report = prepare([tmp_path / "05_04.bvh"], tmp_path / "store")
    assert [(c.name, c.length) for c in report.kept] == [("05_04_part1", 70), ("05_04_part2", 50)]
    assert len({c.split for c in report.kept}) == 1
    assert [loss.reason for loss in report.cut] == ["glitch"]
    assert "2.30 s" in report.cut[0].detail


def test_motion_of_an_earlier_source_is_dropped_wherever_it_stands(tmp_path: Path):
    first = write_walkers(tmp_path / "first", {"05_02": 1, "05_03": 2})
    moved = walker(120, seed=1, fps=60.0, name="again")
    larger = dataclasses.replace(moved, positions=1.1 * moved.positions)[16:]
    (tmp_path / "second").mkdir()
    write_bvh(tmp_path / "second" / "again.bvh", larger)
    report = prepare([first, tmp_path / "second"], tmp_path / "store")
    assert reasons(report) == {"again": "duplicate"}
    assert "05_02" in report.dropped[0].detail
    report = prepare([tmp_path / "second", first], tmp_path / "store")
    assert reasons(report) == {"05_02": "duplicate"}


def test_a_person_who_repeats_a_motion_is_no_duplicate_within_a_source(tmp_path: Path):
    source = write_walkers(tmp_path / "bvh", {"05_02": 1})
    motion = walker(120, seed=1, fps=60.0, name="05_03")
    lower = [motion.skeleton.index(f"{side}_foot") for side in ("left", "right")]
    motion.positions[:, lower, 0] += 0.01 * np.sin(np.arange(120) / 8)[:, None]
    write_bvh(source / "05_03.bvh", motion)
    assert prepare([source], tmp_path / "store").dropped == ()


def test_a_store_is_replaced_as_a_whole_and_nothing_else_is(tmp_path: Path):
    source = write_walkers(tmp_path / "bvh", {"05_02": 1})
    prepare([source], tmp_path / "store")
    (tmp_path / "store" / "rotations.npy").write_bytes(b"of an older store")
    prepare([source], tmp_path / "store", skeleton=H36M17)
    assert not (tmp_path / "store" / "rotations.npy").exists()
    with pytest.raises(StoreError, match="other files"):
        prepare([source], source)
    assert (source / "05_02.bvh").exists()


@pytest.mark.parametrize("missing", ["nowhere", "empty"])
def test_a_source_without_motion_is_an_error_of_one_line(tmp_path: Path, missing: str):
    (tmp_path / "empty").mkdir()
    with pytest.raises(PrepareError, match=f"{missing}: found no") as error:
        prepare([tmp_path / missing], tmp_path / "store")
    assert "\n" not in str(error.value)


def test_nothing_usable_is_an_error_that_names_the_first_cause(tmp_path: Path):
    (tmp_path / "05_02.bvh").write_text("HIERARCHY\nROOT")
    with pytest.raises(PrepareError, match=r"none of 1 takes can be used; the first: 05_02\.bvh:"):
        prepare([tmp_path / "05_02.bvh"], tmp_path / "store")
    assert not (tmp_path / "store").exists()


def test_names_of_public_collections_tell_their_fields():
    said = [take_fields(Path("some") / name) for name in (
        "dataset-1_bow_angry_001.bvh", "131_04.amc", "005_02.bvh",
        "HDM_bd_squat1Reps_001_120.amc", "dance.bvh",
    )]  # fmt: skip
    assert said == [
        {"source": "bandai-1", "action": "bow", "style": "angry"},
        {"source": "cmu-amc", "subject": "131"},
        {"source": "cmu-bvh", "subject": "05"},
        {"source": "hdm05", "subject": "bd", "action": "squat1Reps"},
        {"source": "some"},
    ]


def test_split_depends_on_the_take_alone_and_holds_about_eight_percent():
    splits = [split_of(f"take{i}") for i in range(2000)]
    assert 0.06 < splits.count("valid") / 2000 < 0.10
    assert splits == [split_of(f"take{i}_part2_part1") for i in range(2000)]


def test_a_joint_that_leaps_for_one_frame_is_a_glitch_on_both_sides():
    motion = walker(60)
    motion.positions[30, 8] += [0.0, 0.0, 0.6]
    glitches = glitch_steps(
        motion.positions, skeleton=motion.skeleton, fps=30.0, limits=GlitchLimits()
    )
    np.testing.assert_array_equal(np.flatnonzero(glitches), [29, 30])
    parts, lost = clean_parts(glitches, shortest=30)
    assert parts == (slice(0, 30),)
    assert lost == 30


def test_walking_has_no_glitch():
    motion = walker(300)
    assert not glitch_steps(
        motion.positions, skeleton=motion.skeleton, fps=30.0, limits=GlitchLimits()
    ).any()


@pytest.mark.skipif(not SAMPLES.is_dir(), reason="the samples of the original files are not here")
def test_original_files_become_a_store(tmp_path: Path):
    report = prepare([SAMPLES], tmp_path / "store")
    sources = {clip.name: clip.source for clip in report.kept}
    assert sources["dataset-2_run_active_036"] == "bandai-2"
    assert sources["007_12_part1"] == "cmu-bvh"  # it begins with a T-pose
    assert sources["03_02_part1"] == "cmu-amc"
    assert reasons(report) == {"003_02_part1": "duplicate"}  # 03_02 on another rig
    store = open_store(tmp_path / "store")
    heights = [
        np.median(np.ptp(store.clip_positions(clip)[..., 2], axis=1)) for clip in store.clips
    ]
    assert 1.2 < min(heights) < max(heights) < 1.9
