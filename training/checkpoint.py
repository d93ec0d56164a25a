"""Checkpoints of a training run: written whole or not at all."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

CHECKPOINT_FILE = "checkpoint.pt"


class CheckpointError(Exception):
    """A checkpoint is missing or cannot be read."""


def save_checkpoint(folder: Path, state: Mapping[str, Any]) -> None:
    """Replace the run's checkpoint; one that is killed while it writes leaves the old one."""
    folder.mkdir(parents=True, exist_ok=True)
    scratch = folder / f".{CHECKPOINT_FILE}.new"
    with scratch.open("wb") as file:
        torch.save(dict(state), file)
        file.flush()
        os.fsync(file.fileno())
    scratch.replace(folder / CHECKPOINT_FILE)


def load_checkpoint(folder: Path, device: torch.device) -> dict[str, Any]:
    """The run's newest checkpoint.

    Raises:
        CheckpointError: there is none, or the file is damaged.
    """
    path = folder / CHECKPOINT_FILE
    if not path.is_file():
        raise CheckpointError(f"{folder}: found no {CHECKPOINT_FILE}; train the recipe first.")
    try:
        state: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
    except (RuntimeError, EOFError, ValueError) as error:
        raise CheckpointError(
            f"{path}: the file is damaged ({error}); delete it to start the run again."
        ) from error
    return state
