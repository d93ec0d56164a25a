"""Quality and time against denoising steps."""

import json
from pathlib import Path

import pytest
from people import small_store

from models.bundle import read_manifest
from training.data.store import Store
from training.evaluate import EvaluateError, evaluate
from training.step_curve import step_counts, step_curve


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return small_store(tmp_path_factory.mktemp("small") / "store")


@pytest.mark.parametrize(
    ("num_steps", "counts"),
    [(1, (1,)), (4, (1, 2, 3, 4)), (30, (1, 2, 5, 10, 20, 30)), (100, (1, 2, 5, 10, 20, 50, 100))],
)
def test_long_chains_are_looked_at_in_round_numbers(num_steps, counts):
    assert step_counts(num_steps) == counts


def test_curve_has_a_row_for_each_number_of_steps(store: Store, bundles: Path, tmp_path: Path):
    folder = bundles / "diffusion"
    curve = step_curve(
        folder,
        store,
        ("style=old",),
        out=tmp_path,
        num_samples=10,
        max_windows=3,
        rounds=2,
        command="the command",
    )
    assert [row.name for row in curve.rows] == [str(count) for count in range(1, 11)]
    assert all(row.windows == 3 for row in curve.rows)
    first, last = curve.rows[0].scores, curve.rows[-1].scores
    assert last["ade_ratio"] == last["fde_ratio"] == last["share_of_time"] == 1.0
    assert first["ade"] != last["ade"]
    assert all(row.scores["milliseconds"] > 0 for row in curve.rows)
    assert all(0 <= row.scores["covered"] <= 1 for row in curve.rows)

    wanted = evaluate(
        [(folder, read_manifest(folder))],
        store,
        {"old": ("style=old",)},
        out=tmp_path / "evaluation",
        num_samples=10,
        max_windows=3,
        bone_lengths=("observed",),
    )
    full = next(row for row in wanted.rows if row.name == "diffusion").scores
    for key in ("ade", "fde", "apd", "cmd"):
        assert last[key] == pytest.approx(full[key], rel=1e-9)

    table = (tmp_path / "steps_diffusion.md").read_text()
    assert table.startswith("`the command`\n")
    assert table.count("\n| ") == 11
    written = json.loads((tmp_path / "steps_diffusion.json").read_text())
    assert written["protocol"]["num_samples"] == 10
    assert written["rows"][4]["scores"]["apd"] == curve.rows[4].scores["apd"]
    picture = (tmp_path / "steps_diffusion.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    assert len(picture) < 200_000


def test_curve_of_no_clips_is_refused(store: Store, bundles: Path, tmp_path: Path):
    with pytest.raises(EvaluateError, match="style=elder: found no clip"):
        step_curve(bundles / "diffusion", store, ("style=elder",), out=tmp_path)
