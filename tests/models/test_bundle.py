from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from models.bundle import Manifest, ManifestError, read_manifest


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
