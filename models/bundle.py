"""The bundle: a folder of ``manifest.json``, ``*.onnx`` graphs and ``MODEL_CARD.md``.

Errors
    BundleError                 anything wrong with a bundle on disk
    ├── ManifestError           the manifest is missing, unreadable or of another format
    └── CorruptBundleError      a graph is missing or is not the file that was exported
"""

import hashlib
import json
import shutil
import tempfile
from collections.abc import Mapping
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from models.diffusion import Plan, Schedule, timesteps
from models.motion.skeleton import Skeleton

FORMAT_VERSION: Literal[1] = 1
MANIFEST_FILE = "manifest.json"
CARD_FILE = "MODEL_CARD.md"


class BundleError(Exception):
    """A bundle cannot be used."""


class ManifestError(BundleError):
    """The manifest is missing, unreadable or of another format."""


class CorruptBundleError(BundleError):
    """A file of the bundle is missing or differs from the one exported."""


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TensorSpec(_Record):
    """Name and shape of a graph's input or output; "B" stands for the batch."""

    name: str
    shape: tuple[int | str, ...]
    dtype: Literal["float32", "int64"] = "float32"


class GraphSpec(_Record):
    """One ONNX file of the bundle and the tensors it takes and gives."""

    file: str = Field(pattern=r"^[A-Za-z0-9_-]+\.onnx$")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    inputs: tuple[TensorSpec, ...]
    outputs: tuple[TensorSpec, ...]


class SkeletonSpec(_Record):
    """The skeleton that the graphs speak."""

    name: str
    joints: tuple[str, ...]
    parents: tuple[int, ...]

    def skeleton(self) -> Skeleton:
        """The same skeleton as the motion room's type."""
        return Skeleton(name=self.name, joints=self.joints, parents=self.parents)


class ScheduleSpec(_Record):
    """Tables of the diffusion process, which steps fewer of them are, and how many run by default.

    ``default_steps`` of None are all.
    """

    alpha_bar: tuple[float, ...] = Field(min_length=1)
    variance: tuple[tuple[float, ...], ...]
    eta: float = Field(default=0.0, ge=0.0, le=1.0)
    plan: Plan = "stop_early"
    default_steps: int | None = Field(default=None, gt=0)

    @model_validator(mode="after")
    def _has_as_many_steps_as_run_by_default(self) -> "ScheduleSpec":
        if (self.default_steps or 1) > len(self.alpha_bar):
            raise ValueError(
                f"default_steps: must be at most {len(self.alpha_bar)}, the timesteps."
            )
        return self

    def schedule(self) -> Schedule:
        """The tables as arrays."""
        return Schedule(alpha_bar=np.array(self.alpha_bar), variance=np.array(self.variance))


class ActionsSpec(_Record):
    """How a bundle that performs actions is stepped and stopped.

    Its decoder gives ``chunk_frames`` frames at a time; what it returns as ``next_<name>`` is its
    input ``<name>`` for the chunk after. An action ends at the first frame, not before
    ``min_frames`` nor before what the decoder gives as ``earliest_end``, if it does, from which
    ``stop_window`` frames stay within ``stop_threshold_m`` of their mean (Mao et al. 2022, Eq. 8,
    over all joints in metres), or after ``horizon`` frames.
    """

    labels: tuple[str, ...] = Field(min_length=1)
    examples: dict[str, str] = Field(default_factory=dict)
    """For some labels, what a person does who performs it."""
    chunk_frames: int = Field(gt=0)
    min_frames: int = Field(default=1, gt=0)
    stop_window: int = Field(default=5, gt=1)
    stop_threshold_m: float = Field(gt=0)


class CalibrationSpec(_Record):
    """How much wider than its samples' spread a bundle's regions must be to hold the truth.

    ``factors[l][t]`` multiplies the radius of level l at ``times_s[t]`` after the last observed
    frame; between two times it is interpolated, beyond them it stays. Measured with whole chains
    of ``num_samples`` samples on ``num_windows`` windows of the clips ``measured_on``.
    """

    levels: tuple[Annotated[float, Field(gt=0.0, lt=1.0)], ...] = Field(min_length=1)
    times_s: tuple[Annotated[float, Field(gt=0.0)], ...] = Field(min_length=1)
    factors: tuple[tuple[Annotated[float, Field(gt=0.0, allow_inf_nan=False)], ...], ...]
    num_samples: int = Field(gt=0)
    num_windows: int = Field(gt=0)
    measured_on: tuple[str, ...]

    @model_validator(mode="after")
    def _a_factor_for_each_level_and_time(self) -> "CalibrationSpec":
        if [len(row) for row in self.factors] != [len(self.times_s)] * len(self.levels):
            raise ValueError("factors: there must be a row for each level, of one for each time.")
        if any(b <= a for a, b in pairwise(self.times_s)):
            raise ValueError("times_s: must increase.")
        return self

    def at(self, level: float, times_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
        """The factors of one of the levels at some times."""
        return np.asarray(np.interp(times_s, self.times_s, self.factors[self.levels.index(level)]))


class Manifest(_Record):
    """Everything that the generic server must know of a bundle."""

    format_version: Literal[1] = FORMAT_VERSION
    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$")
    version: str
    system: str
    description: str
    licence: str
    attribution: tuple[str, ...] = ()
    skeleton: SkeletonSpec
    fps: float = Field(gt=0)
    num_observed: int = Field(gt=0)
    horizon: int = Field(gt=0)
    trajectory: Literal["world", "root-relative"] = "world"
    symmetries: tuple[Literal["yaw", "translation"], ...] = ()
    schedule: ScheduleSpec | None = None
    x_t_shape: tuple[int, ...] = ()
    """Of a row's noise: x_t where there is a denoiser, else what a graph asks for as ``noise``."""
    actions: ActionsSpec | None = None
    calibration: CalibrationSpec | None = None
    encoder: GraphSpec | None = None
    denoiser: GraphSpec | None = None
    decoder: GraphSpec
    recipe: dict[str, Any] = Field(default_factory=dict)
    training: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _denoiser_has_a_schedule(self) -> "Manifest":
        if (self.denoiser is None) != (self.schedule is None):
            raise ValueError("schedule: a bundle has a denoiser and a schedule, or neither.")
        return self

    @model_validator(mode="after")
    def _actions_are_decoded_in_chunks(self) -> "Manifest":
        if self.actions is not None and self.denoiser is not None:
            raise ValueError("actions: a bundle denoises or performs actions, not both.")
        if self.actions is not None and self.encoder is None:
            raise ValueError("actions: a bundle that performs actions has an encoder.")
        return self

    @model_validator(mode="after")
    def _decoder_gives_as_many_frames_as_are_said(self) -> "Manifest":
        num_frames = self.actions.chunk_frames if self.actions else self.horizon
        shapes = {tensor.name: tensor.shape for tensor in self.decoder.outputs}
        if num_frames not in shapes.get("future", ())[1:2]:
            raise ValueError(f"decoder: must give future (B, {num_frames}, J, 3).")
        return self

    def graphs(self) -> dict[str, GraphSpec]:
        """The graphs that this bundle has, by role, in the order in which they run."""
        roles = {"encoder": self.encoder, "denoiser": self.denoiser, "decoder": self.decoder}
        return {role: graph for role, graph in roles.items() if graph is not None}

    @property
    def num_steps(self) -> int:
        """K, the most denoising steps that can be run; 1 for a bundle without a denoiser."""
        return len(self.schedule.alpha_bar) if self.schedule else 1

    @property
    def default_steps(self) -> int:
        """The denoising steps that run where nothing else is asked for."""
        return (self.schedule and self.schedule.default_steps) or self.num_steps

    def timesteps(self, num_steps: int | None) -> tuple[int, ...]:
        """The timesteps of so many steps, or of the default, by the bundle's own plan."""
        plan = self.schedule.plan if self.schedule else "stop_early"
        return timesteps(self.num_steps, num_steps or self.default_steps, plan=plan)

    def chain_steps(self, num_steps: int | None) -> int:
        """The steps of the chain that so many steps walk along: a stride walks to its end."""
        if self.schedule and self.schedule.plan == "stride":
            return num_steps or self.default_steps
        return self.num_steps

    @cached_property
    def digest(self) -> str:
        """Short sha256 over the graphs and the tables: two bundles that answer alike share it."""
        silent: dict[str, Any] = dict.fromkeys(("recipe", "training", "description"), True)
        # Bundles of before there were these keep their digest.
        if self.calibration is None:
            silent["calibration"] = True
        if self.schedule and not self.schedule.default_steps and self.schedule.plan == "stop_early":
            silent["schedule"] = {"plan", "default_steps"}
        body = self.model_dump(mode="json", exclude=silent)
        return hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()[:16]

    def model_copy(
        self, *, update: Mapping[str, Any] | None = None, deep: bool = False
    ) -> "Manifest":
        """A copy with some fields changed, and so with a digest of its own."""
        copied = super().model_copy(update=update, deep=deep)
        vars(copied).pop("digest", None)
        return copied


def sha256_of(path: Path) -> str:
    """Hexadecimal sha256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def read_manifest(folder: Path) -> Manifest:
    """The manifest of the bundle in a folder, its graphs verified against their sha256.

    Raises:
        ManifestError: manifest.json is missing, not JSON, or of another format.
        CorruptBundleError: a graph is missing or differs from the one exported.
    """
    path = folder / MANIFEST_FILE
    if not path.is_file():
        raise ManifestError(f"{folder.name}: found no {MANIFEST_FILE}; every bundle needs one.")
    try:
        manifest = Manifest.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"]) or "the file"
        raise ManifestError(
            f"{folder.name}/{MANIFEST_FILE}: {field}: {first['msg']}; "
            f"it must follow bundle format {FORMAT_VERSION}."
        ) from error
    for graph in manifest.graphs().values():
        _verify(folder / graph.file, graph.sha256)
    return manifest


def _verify(path: Path, expected: str) -> None:
    if not path.is_file():
        raise CorruptBundleError(f"{path.parent.name}/{path.name}: the file is missing.")
    found = sha256_of(path)
    if found != expected:
        raise CorruptBundleError(
            f"{path.parent.name}/{path.name}: found sha256 {found[:12]}…, the manifest says "
            f"{expected[:12]}…; copy or export the bundle again."
        )


def write_bundle(folder: Path, manifest: Manifest, files: dict[str, bytes]) -> None:
    """Write manifest, graphs and model card together: the whole bundle appears, or nothing does.

    An older bundle in the folder is replaced. ``files`` holds every other file by name.

    Raises:
        CorruptBundleError: a graph's bytes are missing or do not have the manifest's sha256.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".writing-") as scratch:
        new = Path(scratch) / folder.name
        new.mkdir()
        for name, content in files.items():
            (new / name).write_bytes(content)
        for graph in manifest.graphs().values():
            _verify(new / graph.file, graph.sha256)
        (new / MANIFEST_FILE).write_text(_as_text(manifest))
        if folder.exists():
            shutil.move(folder, Path(scratch) / "old")
        new.rename(folder)


def write_calibration(folder: Path, calibration: CalibrationSpec) -> Manifest:
    """Put a calibration into the manifest of a folder, whole or not at all; return the manifest.

    Raises:
        BundleError: the folder holds no bundle that can be used.
    """
    manifest = read_manifest(folder).model_copy(update={"calibration": calibration})
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".writing-") as scratch:
        new = Path(scratch) / MANIFEST_FILE
        new.write_text(_as_text(manifest))
        new.replace(folder / MANIFEST_FILE)
    return manifest


def _as_text(manifest: Manifest) -> str:
    return manifest.model_dump_json(indent=1) + "\n"
