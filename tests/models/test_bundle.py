import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from models.bundle import (
    CalibrationSpec,
    Manifest,
    ManifestError,
    read_manifest,
    write_calibration,
)


def changed(folder: Path, **fields: Any) -> Manifest:
    """The manifest in a folder with other fields, as if it had been read."""
    return Manifest.model_validate(read_manifest(folder).model_dump() | fields)


def test_manifest_that_performs_actions_survives_its_file(actions_bundle: Path):
    manifest = read_manifest(actions_bundle)
    assert Manifest.model_validate_json(manifest.model_dump_json()) == manifest


def test_actions_need_an_encoder(actions_bundle: Path):
    with pytest.raises(ValidationError, match="performs actions has an encoder"):
        changed(actions_bundle, encoder=None)


def test_bundle_denoises_or_performs_actions(actions_bundle: Path, bundles: Path):
    diffusion = read_manifest(bundles / "diffusion").model_dump()
    with pytest.raises(ValidationError, match="denoises or performs actions, not both"):
        changed(actions_bundle, denoiser=diffusion["denoiser"], schedule=diffusion["schedule"])


def test_decoder_gives_a_chunk_of_an_action(actions_bundle: Path):
    spec = read_manifest(actions_bundle).actions
    assert spec is not None
    with pytest.raises(ValidationError, match=r"must give future \(B, 9, J, 3\)"):
        changed(actions_bundle, actions=spec.model_dump() | {"chunk_frames": 9})


def test_decoder_gives_the_horizon_where_there_are_no_actions(bundles: Path):
    with pytest.raises(ValidationError, match=r"must give future \(B, 61, J, 3\)"):
        changed(bundles / "still", horizon=61)


@pytest.mark.parametrize(
    ("field", "value"),
    [("labels", ()), ("chunk_frames", 0), ("stop_window", 1), ("stop_threshold_m", 0.0)],
)
def test_number_that_no_action_has_is_refused(actions_bundle: Path, field: str, value: object):
    spec = read_manifest(actions_bundle).actions
    assert spec is not None
    with pytest.raises(ValidationError, match=rf"actions\.{field}"):
        changed(actions_bundle, actions=spec.model_dump() | {field: value})


def test_file_that_is_wrong_of_its_actions_says_where(actions_bundle: Path, tmp_path: Path):
    text = read_manifest(actions_bundle).model_dump_json()
    (tmp_path / "manifest.json").write_text(text.replace('"chunk_frames":8', '"chunk_frames":-8'))
    with pytest.raises(ManifestError, match=r"actions\.chunk_frames"):
        read_manifest(tmp_path)


def planned(folder: Path, **fields: Any) -> Manifest:
    schedule = read_manifest(folder).schedule
    assert schedule is not None
    return changed(folder, schedule=schedule.model_dump() | fields)


def test_steps_stop_early_where_a_manifest_says_nothing_of_them(bundles: Path):
    manifest = read_manifest(bundles / "diffusion")
    assert manifest.timesteps(None) == tuple(range(9, -1, -1))
    assert manifest.timesteps(4) == (9, 8, 7, 6)
    assert (manifest.default_steps, manifest.chain_steps(4)) == (10, 10)


def test_stride_walks_to_the_end_in_as_many_steps_as_are_asked_for(bundles: Path):
    manifest = planned(bundles / "diffusion", plan="stride", default_steps=5)
    assert manifest.timesteps(None) == (9, 7, 5, 3, 1)
    assert manifest.timesteps(2) == (9, 4)
    assert (manifest.default_steps, manifest.chain_steps(None)) == (5, 5)
    assert (manifest.num_steps, manifest.chain_steps(2)) == (10, 2)


def test_plan_counts_for_the_digest_and_its_absence_does_not(bundles: Path):
    manifest = read_manifest(bundles / "diffusion")
    assert planned(bundles / "diffusion", plan="stop_early").digest == manifest.digest
    others = {"plan": "stride"}, {"default_steps": 5}
    digests = {planned(bundles / "diffusion", **fields).digest for fields in others}
    assert len(digests | {manifest.digest}) == 3


def test_default_of_more_steps_than_there_are_is_refused(bundles: Path):
    with pytest.raises(ValidationError, match="at most 10"):
        planned(bundles / "diffusion", default_steps=11)


CALIBRATION = CalibrationSpec(
    levels=(0.5, 0.9),
    times_s=(0.1, 0.3),
    factors=((1.0, 2.0), (3.0, 1.0)),
    num_samples=50,
    num_windows=100,
    measured_on=("split=valid",),
)


def test_calibration_is_written_beside_what_was_there(bundles: Path, tmp_path: Path):
    folder = shutil.copytree(bundles / "diffusion", tmp_path / "diffusion")
    before = read_manifest(folder)
    written = write_calibration(folder, CALIBRATION)
    assert read_manifest(folder) == written
    assert written.calibration == CALIBRATION
    assert written.model_copy(update={"calibration": None}) == before
    assert [path.name for path in tmp_path.iterdir()] == ["diffusion"]
    assert {path.name for path in folder.iterdir()} == {
        path.name for path in (bundles / "diffusion").iterdir()
    }


def test_bundle_answers_otherwise_once_it_is_calibrated(bundles: Path):
    before = read_manifest(bundles / "diffusion")
    after = changed(bundles / "diffusion", calibration=CALIBRATION)
    assert after.digest != before.digest
    assert before.model_copy(update={"calibration": CALIBRATION}).digest == after.digest


def test_manifest_of_before_calibration_keeps_its_digest(bundles: Path, tmp_path: Path):
    folder = shutil.copytree(bundles / "diffusion", tmp_path / "diffusion")
    path = folder / "manifest.json"
    content = json.loads(path.read_text())
    del content["calibration"]
    path.write_text(json.dumps(content))
    assert read_manifest(folder).digest == read_manifest(bundles / "diffusion").digest


def test_factors_are_interpolated_and_stay_beyond_their_times():
    factors = CALIBRATION.at(0.9, np.array([0.01, 0.1, 0.2, 0.3, 9.0]))
    np.testing.assert_allclose(factors, [3.0, 3.0, 2.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"factors": ((1.0, 2.0),)}, "a row for each level"),
        ({"factors": ((1.0,), (1.0,))}, "one for each time"),
        ({"factors": ((1.0, 2.0), (1.0, float("inf")))}, "finite"),
        ({"times_s": (0.3, 0.1)}, "must increase"),
        ({"levels": (0.5, 1.0)}, "less than 1"),
    ],
)
def test_calibration_that_cannot_be_is_refused(fields: dict[str, Any], message: str):
    with pytest.raises(ValidationError, match=message):
        CalibrationSpec.model_validate(CALIBRATION.model_dump() | fields)
