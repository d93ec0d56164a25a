"""The command line ``posefutures``: serve, predict, stream, convert, models, actions."""

import asyncio
import socket
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import asynccontextmanager, contextmanager, nullcontext
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
import typer
import uvicorn
from jaxtyping import Float, Shaped
from pydantic import ValidationError

from models.bundle import BundleError
from models.motion.bones import with_fixed_bones
from models.motion.formats.errors import FormatError
from models.motion.formats.files import SUFFIXES, WRITTEN_SUFFIXES, read_motion, write_motion
from models.motion.gaps import without_gaps
from models.motion.kinematics import inverse_kinematics
from models.motion.motion import Motion
from service import server
from service.app import create_app
from service.asking.exchange import ClientError
from service.asking.messages import (
    ActionsOptions,
    ActionsPrediction,
    ActionsPreview,
    Prediction,
    PredictOptions,
    Preview,
)
from service.asking.replay import recorded, replayed, told
from service.catalog import Catalog
from service.client import AsyncClient
from service.errors import FieldError, ServiceError
from service.poses.skeletons import standard_skeleton
from service.schemas import MAX_SEED, MAX_STOP_THRESHOLD_M, MAX_STREAM_HZ
from service.settings import Settings

_READ = f"a motion: {', '.join(SUFFIXES)} (.amc beside its .asf), or a folder of OpenPose's frames"
SENT_S = 10.0  # of a motion, up to now: more than any bundle looks at

app = typer.Typer(
    help="N plausible futures of a person's 3D motion.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)


class OutputFormat(StrEnum):
    """What ``predict`` writes."""

    BVH = "bvh"
    GLB = "glb"
    JSON = "json"
    NPZ = "npz"


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="address to listen on")] = None,
    port: Annotated[int | None, typer.Option(help="port to listen on")] = None,
) -> None:
    """Serve the bundles over HTTP; settings are POSEFUTURES_* variables."""
    with _one_line_errors():
        settings = Settings()
        server.serve(settings, host=host or settings.host, port=port or settings.port)


@app.command()
def models() -> None:
    """List the bundles."""
    with _one_line_errors():
        catalog = _catalog()
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
        for name, spec in _catalog().performers().items():
            typer.echo(name)
            for label in spec.labels:
                typer.echo(f"  {label}  {spec.examples.get(label, '')}".rstrip())


@app.command()
def predict(
    file: Annotated[Path, typer.Argument(help=_READ)],
    num_samples: Annotated[int, typer.Option(min=1, help="how many futures")] = 10,
    num_steps: Annotated[int | None, typer.Option(min=1, help="denoising steps")] = None,
    deadline_ms: Annotated[
        float | None, typer.Option(help="answer by then with what is ready")
    ] = None,
    tolerance_m: Annotated[
        float | None, typer.Option(help="stop a future that a step moves by less")
    ] = None,
    horizon_s: Annotated[float | None, typer.Option(help="seconds to predict")] = None,
    num_modes: Annotated[
        int | None, typer.Option(min=1, help="tell so many that stand for all")
    ] = None,
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
    url: Annotated[
        str | None,
        typer.Option(help="a server, such as http://127.0.0.1:8000; one of its own else"),
    ] = None,
    stream: Annotated[bool, typer.Option(help="tell of each step")] = False,
) -> None:
    """Write N futures of the motion in a file, in its own skeleton and frame rate."""
    with _one_line_errors():
        motion = read_motion(file)
        seen = _until(motion, at)
        labels = None if actions is None else [label.strip() for label in actions.split(",")]
        options = _options(
            performs=labels is not None,
            num_steps=num_steps,
            deadline_ms=deadline_ms,
            tolerance_m=tolerance_m,
            horizon_s=horizon_s,
            num_modes=num_modes,
            stop_threshold=stop_threshold,
            max_seconds_per_action=max_seconds_per_action,
            num_samples=num_samples,
            model=model,
            seed=seed,
        )
        options |= {"fps": motion.fps, "skeleton": _skeleton(motion)}
        answer = asyncio.run(_answered(seen, labels, options, url=url, stream=stream))
        out.mkdir(parents=True, exist_ok=True)
        for warning in answer.warnings:
            typer.echo(f"warning: {warning}", err=True)
        if output_format is OutputFormat.NPZ:
            _write_npz(out, motion, answer)
        else:
            _write_files(out, motion, list(answer.futures), output_format)
        if isinstance(answer, Prediction):
            _tell(answer)
        typer.echo(
            f"{num_samples} futures of {file.name} by {answer.model}, seed {answer.seed}, in {out}"
        )


@app.command()
def convert(
    file: Annotated[Path, typer.Argument(help=_READ)],
    out: Annotated[Path, typer.Argument(help=f"a file: {', '.join(WRITTEN_SUFFIXES)}")],
    skeleton: Annotated[
        str | None, typer.Option(help="a standard skeleton to put it on; its own by default")
    ] = None,
    fps: Annotated[float | None, typer.Option(min=1, max=1000, help="frames per second")] = None,
    fix_bones: Annotated[
        bool,
        typer.Option(
            "--fix-bones", help="give each bone the median of its lengths, as for a webcam"
        ),
    ] = False,
) -> None:
    """Write the motion in a file as a file of another kind."""
    with _one_line_errors():
        motion = read_motion(file)
        if skeleton is not None:
            motion = without_gaps(motion).to(standard_skeleton(skeleton))
        if fps is not None:
            motion = without_gaps(motion).resample(fps)
        if fix_bones:
            motion = with_fixed_bones(without_gaps(motion))
        write_motion(out, motion)
        typer.echo(
            f"{motion.num_frames} frames of {motion.skeleton.num_joints} joints at "
            f"{motion.fps:g} frames a second, in {out}"
        )


@app.command()
def stream(
    file: Annotated[Path, typer.Argument(help=_READ)],
    rate_hz: Annotated[
        float, typer.Option(min=0.1, max=MAX_STREAM_HZ, help="answers a second, at most")
    ] = 10.0,
    num_samples: Annotated[int, typer.Option(min=1, help="how many futures")] = 10,
    deadline_ms: Annotated[
        float | None, typer.Option(help="answer by then with what is ready")
    ] = None,
    model: Annotated[str | None, typer.Option(help="a bundle's name")] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=MAX_SEED)] = None,
    speed: Annotated[float, typer.Option(min=0.01, help="1 is real time")] = 1.0,
    out: Annotated[Path | None, typer.Option(help="file for the answers, one JSON a line")] = None,
    url: Annotated[
        str | None,
        typer.Option(help="a server, such as http://127.0.0.1:8000; one of its own else"),
    ] = None,
) -> None:
    """Replay the motion in a file as a live stream, and tell of each answer."""
    with _one_line_errors(), nullcontext() if out is None else out.open("wb") as records:
        motion = read_motion(file)
        options: PredictOptions = {
            "num_samples": num_samples,
            "deadline_ms": deadline_ms,
            "model": model,
            "seed": seed,
            "fps": motion.fps,
            "skeleton": _skeleton(motion),
        }

        async def replay() -> None:
            async with _client(url) as client, client.live(rate_hz=rate_hz, **options) as live:
                async for answer in replayed(motion, live, speed=speed):
                    typer.echo(told(answer))
                    if records is not None:
                        records.write(recorded(answer))

        asyncio.run(replay())


def _tell(answer: Prediction) -> None:
    """What of an answer is no file: where it stopped early, and which futures stand for all."""
    steps = answer.steps
    if steps.stopped_by != "end":
        typer.echo(f"{steps.run} of {steps.of} steps: stopped by {steps.stopped_by}")
    for mode in answer.modes:
        typer.echo(f"{100.0 * mode.probability:.0f} % like future {mode.sample}")


def _options(*, performs: bool, **asked: Any) -> dict[str, Any]:
    """What is asked for, of the options that such a request has."""
    options = {name: value for name, value in asked.items() if value is not None}
    if "num_modes" in options:
        options["returned"] = ["futures", "modes"]
    known = (ActionsOptions if performs else PredictOptions).__annotations__
    for name in sorted(options.keys() - known):
        raise FieldError(
            pointer=f"/{name}",
            found=f"{options[name]}",
            expected=f"it is for a request with{'out' if performs else ''} --actions",
        )
    return options


def _skeleton(motion: Motion) -> dict[str, Any]:
    """The skeleton of a file as a request describes it."""
    skeleton = motion.skeleton
    return {"joints": list(skeleton.joints), "parents": list(skeleton.parents)}


def _catalog() -> Catalog:
    catalog: Catalog = create_app(Settings()).state.catalog
    return catalog


async def _answered(
    seen: Motion,
    labels: list[str] | None,
    options: dict[str, Any],
    *,
    url: str | None,
    stream: bool,
) -> Prediction | ActionsPrediction:
    async with _client(url) as client:
        if labels is None and not stream:
            return await client.predict(seen.positions, **options)
        if labels is None:
            return await _streamed(client.stream(seen.positions, **options), seen.positions[-1:])
        if not stream:
            return await client.predict_actions(seen.positions, labels, **options)
        return await _performed_so_far(client.stream_actions(seen.positions, labels, **options))


async def _streamed(
    events: AsyncIterator[Preview | Prediction], before: Float[np.ndarray, "*N H J 3"]
) -> Prediction:
    """The prediction, after a line on stderr for each step before the last."""
    async for event in events:
        if isinstance(event, Prediction):
            prediction = event
        else:
            moved = np.linalg.norm(event.futures - before, axis=-1).max()
            typer.echo(f"step {event.run} of {event.of}: {moved:.3f} m moved", err=True)
        before = event.futures
    return prediction


async def _performed_so_far(
    events: AsyncIterator[ActionsPreview | ActionsPrediction],
) -> ActionsPrediction:
    """The prediction, after a line on stderr for each chunk of frames before the last."""
    async for event in events:
        if isinstance(event, ActionsPrediction):
            prediction = event
        else:
            frames = [len(future) for future in event.futures]
            typer.echo(
                f"step {event.run} of {event.of} at most: {min(frames)} to {max(frames)} frames",
                err=True,
            )
    return prediction


@asynccontextmanager
async def _client(url: str | None) -> AsyncIterator[AsyncClient]:
    """A client of the server at ``url``, or of one that lives as long as the context."""
    settings = Settings()
    keys = [key.get_secret_value() for key in settings.api_keys]
    async with (
        _server(url, settings) as address,
        AsyncClient(address, api_key=keys[0] if keys else None) as client,
    ):
        yield client


@asynccontextmanager
async def _server(url: str | None, settings: Settings) -> AsyncIterator[str]:
    """The address of a server: the one at ``url``, or one that lives as long as the context."""
    if url is not None:
        yield url
        return
    application = create_app(settings)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        host, port = listener.getsockname()
        running = uvicorn.Server(uvicorn.Config(application, log_config=None))
        serving = asyncio.create_task(running.serve([listener]))
        try:
            while application.state.catalog.state == "loading" and not serving.done():
                await asyncio.sleep(0.01)
            yield f"http://{host}:{port}"
        finally:
            running.should_exit = True
            await serving


def _until(motion: Motion, at: float | None) -> Motion:
    """The frames up to a second of the motion, and of those the last ones."""
    end = motion.num_frames if at is None else round(at * motion.fps) + 1
    if not 1 <= end <= motion.num_frames:
        raise FieldError(
            pointer="/at",
            found=f"{at:g} s",
            expected=f"{motion.name} lasts from 0 s to {motion.duration:.2f} s",
        )
    return motion[max(0, end - round(SENT_S * motion.fps)) : end]


def _write_files(
    out: Path,
    motion: Motion,
    futures: Sequence[Float[np.ndarray, "_ J 3"]],
    output_format: OutputFormat,
) -> None:
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
        write_motion(out / f"{name}.{output_format}", sample)


def _write_npz(out: Path, motion: Motion, answer: Prediction | ActionsPrediction) -> None:
    """One array of all futures, shorter ones repeating their last frame, beside what they are."""
    longest = max(len(future) for future in answer.futures)
    futures = [
        np.pad(future, ((0, longest - len(future)), (0, 0), (0, 0)), mode="edge")
        for future in answer.futures
    ]
    told = _performed(answer) if isinstance(answer, ActionsPrediction) else _modes(answer)
    np.savez(
        out / f"{motion.name}-futures.npz",
        allow_pickle=False,
        futures=np.array(futures, dtype=np.float32),
        joints=np.array(motion.skeleton.joints),
        parents=np.array(motion.skeleton.parents),
        fps=np.float64(motion.fps),
        **told,
    )


def _performed(answer: ActionsPrediction) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Labels (A,), and for each future and action the end in frames, and whether it stopped."""
    ends = np.array([[part.end for part in parts] for parts in answer.segments])
    return {
        "lengths": ends[:, -1],
        "actions": np.array([part.action for part in answer.segments[0]]),
        "segment_ends": ends,
        "stopped": np.array([[part.stopped for part in parts] for parts in answer.segments]),
    }


def _modes(answer: Prediction) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Of each mode the future that stands for it (M,), and its probability (M,)."""
    if not answer.modes:
        return {}
    return {
        "modes": np.array([mode.sample for mode in answer.modes]),
        "probabilities": np.array([mode.probability for mode in answer.modes]),
    }


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
    except (ServiceError, ClientError, BundleError, FormatError) as error:
        _fail(str(error))


def _fail(message: str) -> NoReturn:
    typer.echo(f"posefutures: {' '.join(message.split())}", err=True)
    raise typer.Exit(2)
