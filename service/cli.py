"""The command line ``posefutures``: serve, predict, models, actions."""

import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, NoReturn

import numpy as np
import typer
import uvicorn
from jaxtyping import Float, Shaped
from pydantic import ValidationError

from models.bundle import BundleError
from models.motion.formats.bvh import write_bvh
from models.motion.formats.errors import FormatError
from models.motion.formats.files import read_motion
from models.motion.kinematics import inverse_kinematics
from models.motion.motion import Motion
from service.actions import action_indices, max_frames
from service.app import create_app
from service.axes import Axes
from service.catalog import Catalog
from service.engine import engine
from service.engine.trajectory import Request, Segment
from service.errors import FieldError, ServiceError
from service.futures import caller_futures, caller_segments
from service.observation import frames_needed, observe
from service.schemas import MAX_SEED, MAX_STOP_THRESHOLD_M
from service.settings import Settings

app = typer.Typer(
    help="N plausible futures of a person's 3D motion.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


class OutputFormat(StrEnum):
    """What ``predict`` writes."""

    BVH = "bvh"
    NPZ = "npz"


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="address to listen on")] = None,
    port: Annotated[int | None, typer.Option(help="port to listen on")] = None,
) -> None:
    """Serve the bundles over HTTP; settings are POSEFUTURES_* variables."""
    with _one_line_errors():
        settings = Settings()
        uvicorn.run(
            create_app(settings),
            host=host or settings.host,
            port=port or settings.port,
            timeout_graceful_shutdown=10,
        )


@app.command()
def models() -> None:
    """List the bundles."""
    with _one_line_errors():
        catalog = _catalog(Settings())
        defaults = [catalog.default(with_actions=kind) for kind in (False, True)]
        for name, entry in catalog.entries.items():
            mark = "*" if entry in defaults else " "
            if entry.manifest is None:
                typer.echo(f"{mark} {name}  refused: {entry.reason}")
            else:
                manifest = entry.manifest
                typer.echo(f"{mark} {name}  {manifest.version}  {manifest.description}")


@app.command()
def actions() -> None:
    """List the actions that each bundle performs."""
    with _one_line_errors():
        for name, spec in _catalog(Settings()).performers().items():
            typer.echo(name)
            for label in spec.labels:
                typer.echo(f"  {label}  {spec.examples.get(label, '')}".rstrip())


@app.command()
def predict(
    file: Annotated[Path, typer.Argument(help="a motion: .bvh, .amc beside its .asf, or .npz")],
    num_samples: Annotated[int, typer.Option(min=1, help="how many futures")] = 10,
    num_steps: Annotated[int | None, typer.Option(min=1, help="stop early")] = None,
    model: Annotated[str | None, typer.Option(help="a bundle's name")] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=MAX_SEED)] = None,
    out: Annotated[Path, typer.Option(help="folder to write into")] = Path(),
    output_format: Annotated[OutputFormat, typer.Option("--format")] = OutputFormat.BVH,
    at: Annotated[float | None, typer.Option(help="second that is now; the end by default")] = None,
    actions: Annotated[str | None, typer.Option(help="labels to perform, such as walk,run")] = None,
    stop_threshold: Annotated[
        float | None,
        typer.Option(max=MAX_STOP_THRESHOLD_M, help="metres within which an action has ended"),
    ] = None,
    max_seconds_per_action: Annotated[
        float | None, typer.Option(help="when an action is cut off")
    ] = None,
) -> None:
    """Write N futures of the motion in a file, in its own skeleton and frame rate."""
    with _one_line_errors():
        motion = read_motion(file)
        catalog = _catalog(Settings())
        labels = [] if actions is None else [label.strip() for label in actions.split(",")]
        bundle = catalog.engine(catalog.chosen(model, with_actions=actions is not None))
        manifest = bundle.manifest
        seen = _until(motion, at, num_frames=frames_needed(manifest, motion.fps))
        seed = secrets.randbelow(MAX_SEED + 1) if seed is None else seed
        observation = observe(
            seen.positions.astype(np.float64),
            skeleton=seen.skeleton,
            order=tuple(range(seen.skeleton.num_joints)),
            axes=Axes(),
            fps=seen.fps,
            manifest=manifest,
        )
        request = Request(
            observation=observation.positions,
            num_samples=num_samples,
            num_steps=num_steps,
            seed=seed,
            actions=action_indices(labels, manifest),
            stop_threshold_m=stop_threshold,
            max_frames=max_frames(max_seconds_per_action, manifest),
        )
        result = engine.predict(bundle, request)
        futures = caller_futures(
            result.futures,
            observation,
            manifest=manifest,
            bone_lengths="observed",
            segments=result.segments,
        )
        segments = caller_segments(result.segments, manifest=manifest, fps=seen.fps)
        out.mkdir(parents=True, exist_ok=True)
        for warning in observation.warnings:
            typer.echo(f"warning: {warning}", err=True)
        if output_format is OutputFormat.BVH:
            ends = [parts[-1].end for parts in segments] or [futures.shape[1]] * len(futures)
            _write_bvh(
                out, motion, [future[:end] for future, end in zip(futures, ends, strict=True)]
            )
        else:
            _write_npz(out, motion, futures, **_performed(labels, segments))
        typer.echo(
            f"{num_samples} futures of {file.name} by {manifest.name}, seed {seed}, in {out}"
        )


def _catalog(settings: Settings) -> Catalog:
    return Catalog(settings.bundles, default_model=settings.default_model, threads=settings.threads)


def _until(motion: Motion, at: float | None, *, num_frames: int) -> Motion:
    """The frames up to a second of the motion."""
    if at is None:
        return motion
    end = round(at * motion.fps) + 1
    if not num_frames <= end <= motion.num_frames:
        raise FieldError(
            pointer="/at",
            found=f"{at:g} s",
            expected=(
                f"{motion.name} can be continued from {(num_frames - 1) / motion.fps:.2f} s "
                f"to {motion.duration:.2f} s"
            ),
        )
    return motion[:end]


def _write_bvh(out: Path, motion: Motion, futures: Sequence[Float[np.ndarray, "_ J 3"]]) -> None:
    width = len(str(len(futures) - 1))
    for i, future in enumerate(futures):
        rotations = None
        if motion.rest_offsets is not None:
            rotations = inverse_kinematics(
                future, motion.rest_offsets.astype(np.float64), motion.skeleton.parents
            )
        name = f"{motion.name}-future-{i:0{width}d}"
        sample = Motion(
            name=name,
            skeleton=motion.skeleton,
            positions=future,
            fps=motion.fps,
            rotations=rotations,
            rest_offsets=motion.rest_offsets,
        )
        write_bvh(out / f"{name}.bvh", sample)


def _performed(
    labels: Sequence[str], segments: Sequence[Sequence[Segment]]
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Labels (A,), and for each future and action the end in frames, and whether it stopped."""
    if not segments:
        return {}
    ends = np.array([[part.end for part in parts] for parts in segments])
    return {
        "lengths": ends[:, -1],
        "actions": np.array(labels),
        "segment_ends": ends,
        "stopped": np.array([[part.stopped for part in parts] for parts in segments]),
    }


def _write_npz(
    out: Path,
    motion: Motion,
    futures: Float[np.ndarray, "N H J 3"],
    **performed: Shaped[np.ndarray, "..."],
) -> None:
    np.savez(
        out / f"{motion.name}-futures.npz",
        allow_pickle=False,
        futures=futures.astype(np.float32),
        joints=np.array(motion.skeleton.joints),
        parents=np.array(motion.skeleton.parents),
        fps=np.float64(motion.fps),
        **performed,
    )


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """Whatever the user can mend becomes one line on stderr and exit code 2."""
    try:
        yield
    except ValidationError as error:
        first = error.errors()[0]
        field = "_".join(str(part) for part in first["loc"]).upper()
        _fail(f"POSEFUTURES_{field}: found {first['input']!r}; {first['msg']}.")
    except OSError as error:
        _fail(f"{error.filename or 'the file'}: {error.strerror or error}.")
    except (ServiceError, BundleError, FormatError) as error:
        _fail(str(error))


def _fail(message: str) -> NoReturn:
    typer.echo(f"posefutures: {' '.join(message.split())}", err=True)
    raise typer.Exit(2)
