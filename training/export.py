"""From a trained network to a bundle: graphs, parity, manifest; all or nothing."""

import datetime
import hashlib
import io
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from jaxtyping import Float
from torch import Tensor, nn

from models.bundle import (
    CARD_FILE,
    ActionsSpec,
    GraphSpec,
    Manifest,
    ScheduleSpec,
    SkeletonSpec,
    TensorSpec,
    write_bundle,
)
from models.diffusion import ddim_step, timesteps
from models.system import Graph, Recipe, describe
from service.engine.engine import Engine
from service.engine.performing import NEXT
from service.engine.runner import Runner
from service.engine.sampling import noise, x_first
from service.engine.trajectory import Request
from service.errors import EngineError

OPSET = 17
PARITY_M = 1e-4
PARITY_BATCHES = (1, 5)
# The exporter holds on to the batch of a recurrence's first state, and one row fits every batch.
# What else holds on to it fails the parity check: the engine runs no graph on a single row.
TRACED_ROWS = 1
BATCH = "B"


class ExportError(Exception):
    """A bundle was not written."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Label:
    """What a bundle says of itself beside what the recipe knows."""

    name: str
    version: str
    licence: str
    attribution: tuple[str, ...] = ()
    description: str | None = None
    training: Mapping[str, Any] | None = None


def export(
    recipe: Recipe,
    network: nn.Module,
    folder: Path,
    *,
    label: Label,
    card: str,
    observations: Float[np.ndarray, "S T J 3"],
) -> Manifest:
    """Write the bundle of a trained network and return its manifest.

    Args:
        recipe: what the network was built from.
        network: the trained network; its graphs' modules are left in evaluation mode, on the CPU.
        folder: where the bundle goes; an older one there is replaced.
        label: name, version, licence and attribution.
        card: the model card, Markdown.
        observations: at least five real or plausible observations, metres, for the parity check.

    Raises:
        ExportError: torch and onnxruntime differ by more than 1e-4 m, or a graph asks for a tensor
            that none gives or takes one batch only. Nothing is written then.
    """
    graphs = {graph.role: graph for graph in recipe.graphs(network.cpu())}
    for graph in graphs.values():
        graph.module.eval()  # the exporter puts back the mode that it found
    seen = observations[: max(PARITY_BATCHES)].astype(np.float32)
    tensors = _example(recipe, graphs, torch.from_numpy(seen[:TRACED_ROWS]))
    specs, files = {}, {CARD_FILE: card.encode()}
    for role, graph in graphs.items():
        content = _onnx(graph, tensors)
        specs[role] = _spec(graph, content, tensors)
        files[specs[role].file] = content
    manifest = _manifest(recipe, label, specs)
    with tempfile.TemporaryDirectory() as scratch:
        trial = Path(scratch) / label.name
        write_bundle(trial, manifest, files)
        _check_parity(recipe, graphs, manifest, trial, seen)
    write_bundle(folder, manifest, files)
    return manifest


def _example(
    recipe: Recipe, graphs: Mapping[str, Graph], observation: Float[Tensor, "B T J 3"]
) -> dict[str, Tensor]:
    rows = len(observation)
    tensors = {"observation": observation}
    if recipe.schedule:
        tensors["x_t"] = torch.zeros(rows, *recipe.x_t_shape)
        tensors["timestep"] = torch.arange(rows)
    if recipe.data.actions:
        tensors["action"] = torch.arange(rows) % len(recipe.data.actions.labels)
        tensors["noise"] = torch.zeros(rows, *recipe.x_t_shape)
    for role in ("encoder", "denoiser", "decoder"):
        if role in graphs:
            tensors |= _run(graphs[role], tensors)
    return tensors


@torch.no_grad()
def _run(graph: Graph, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    missing = [name for name in graph.inputs if name not in tensors]
    if missing:
        raise ExportError(
            f"{graph.role}: asks for {', '.join(missing)}; the graphs before it give "
            f"{', '.join(tensors)}."
        )
    result = graph.module(*(tensors[name] for name in graph.inputs))
    outputs = result if isinstance(result, tuple) else (result,)
    return dict(zip(graph.outputs, outputs, strict=True))


def _onnx(graph: Graph, tensors: Mapping[str, Tensor]) -> bytes:
    buffer = io.BytesIO()
    names = [*graph.inputs, *graph.outputs]
    with warnings.catch_warnings():
        # The exporter warns that it is the older of two. The newer one gives larger graphs that
        # run no faster, and takes a minute where this one takes a second.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            graph.module,
            tuple(tensors[name] for name in graph.inputs),
            buffer,  # type: ignore[arg-type]  # the older exporter takes a file, its stub does not
            input_names=list(graph.inputs),
            output_names=list(graph.outputs),
            dynamic_axes={name: {0: BATCH} for name in names},
            opset_version=OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(buffer.getvalue())
    for node in model.graph.node:
        node.doc_string = ""  # this machine's paths
    onnx.checker.check_model(model)
    return bytes(model.SerializeToString(deterministic=True))


def _spec(graph: Graph, content: bytes, tensors: Mapping[str, Tensor]) -> GraphSpec:
    def spec(name: str) -> TensorSpec:
        value = tensors[name]
        shape = (BATCH, *value.shape[1:])
        if value.dtype == torch.int64:
            return TensorSpec(name=name, shape=shape, dtype="int64")
        return TensorSpec(name=name, shape=shape)

    return GraphSpec(
        file=f"{graph.role}.onnx",
        sha256=hashlib.sha256(content).hexdigest(),
        inputs=tuple(spec(name) for name in graph.inputs),
        outputs=tuple(spec(name) for name in graph.outputs),
    )


def _manifest(recipe: Recipe, label: Label, specs: Mapping[str, GraphSpec]) -> Manifest:
    data, schedule = recipe.data, recipe.schedule
    training = {"exported": datetime.datetime.now(datetime.UTC).date().isoformat()}
    fields: dict[str, Any] = {
        "name": label.name,
        "version": label.version,
        "system": recipe.system,
        "description": label.description or recipe.description,
        "licence": label.licence,
        "attribution": label.attribution,
        "skeleton": SkeletonSpec(
            name=data.skeleton.name, joints=data.skeleton.joints, parents=data.skeleton.parents
        ),
        "fps": data.fps,
        "num_observed": data.num_observed,
        "horizon": data.horizon,
        "trajectory": recipe.trajectory,
        "symmetries": recipe.symmetries,
        "x_t_shape": recipe.x_t_shape,
        "recipe": describe(recipe),
        "training": training | dict(label.training or {}),
    }
    if schedule:
        fields["schedule"] = ScheduleSpec(
            alpha_bar=tuple(schedule.alpha_bar.tolist()),
            variance=tuple(tuple(row) for row in schedule.variance.tolist()),
            eta=recipe.eta,
            plan=recipe.plan,
            default_steps=recipe.default_steps,
        )
    if data.actions:
        fields["actions"] = ActionsSpec(
            labels=tuple(data.actions.labels),
            examples=dict(data.actions.examples),
            chunk_frames=data.actions.chunk_frames,
            min_frames=data.actions.min_frames,
            stop_threshold_m=data.actions.stop_threshold_m,
        )
    return Manifest(**fields, **dict[str, Any](specs))


def trial_request(
    recipe: Recipe, observation: Float[np.ndarray, "T J 3"], *, seed: int, num_samples: int = 1
) -> Request:
    """What a bundle of the recipe is tried with: two actions of two chunks and a half, if any."""
    actions: tuple[int, ...] = ()
    max_frames = None
    if spec := recipe.data.actions:
        actions = (0, len(spec.labels) - 1)
        max_frames = min(recipe.data.horizon, 5 * spec.chunk_frames // 2)
    return Request(
        observation=observation,
        num_samples=num_samples,
        seed=seed,
        actions=actions,
        max_frames=max_frames,
    )


def unstopped(manifest: Manifest) -> Manifest:
    """The same bundle, its actions as long as they may be: no error in rounding ends one early."""
    if manifest.actions is None:
        return manifest
    actions = manifest.actions.model_copy(update={"min_frames": manifest.horizon})
    return manifest.model_copy(update={"actions": actions})


def reference_futures(
    recipe: Recipe,
    graphs: Mapping[str, Graph],
    observation: Float[np.ndarray, "B T J 3"],
    *,
    seed: int,
) -> Float[np.ndarray, "B H J 3"]:
    """Sample 0 of each observation's `trial_request`, `unstopped`, by the whole loop in torch.

    The noise is the server's own.
    """
    tensors = {"observation": torch.from_numpy(observation)}
    if recipe.data.actions:
        return _performed(recipe, graphs, tensors["observation"], seed).numpy()
    if "encoder" in graphs:
        tensors |= _run(graphs["encoder"], tensors)
    if recipe.schedule:
        tensors["x0"] = _denoised(recipe, graphs["denoiser"], tensors, seed)
    return _run(graphs["decoder"], tensors)["future"].numpy()


def _performed(
    recipe: Recipe, graphs: Mapping[str, Graph], observation: Float[Tensor, "B T J 3"], seed: int
) -> Float[Tensor, "B H J 3"]:
    num_rows, num_observed = observation.shape[:2]
    request = trial_request(recipe, observation[0].numpy(), seed=seed)
    frames = observation
    for k, action in enumerate(request.actions):
        (drawn,) = noise(recipe.x_t_shape, seed=seed, sample_indices=(0,), draw=k)
        tensors = {
            "observation": frames[:, -num_observed:],
            "action": torch.full((num_rows,), action),
            "noise": torch.from_numpy(drawn).expand(num_rows, *recipe.x_t_shape),
        }
        tensors |= _run(graphs["encoder"], tensors)
        made = frames[:, :0]
        while made.shape[1] < (request.max_frames or recipe.data.horizon):
            outputs = _run(graphs["decoder"], tensors)
            made = torch.cat([made, outputs["future"]], dim=1)
            tensors |= {
                name.removeprefix(NEXT): value
                for name, value in outputs.items()
                if name.startswith(NEXT)
            }
        frames = torch.cat([frames, made[:, : request.max_frames]], dim=1)
    return frames[:, num_observed:]


def _denoised(recipe: Recipe, denoiser: Graph, tensors: Mapping[str, Tensor], seed: int) -> Tensor:
    schedule = recipe.schedule
    if schedule is None:
        raise ExportError("denoiser: the recipe has no schedule.")
    rows = len(tensors["observation"])
    (first,) = x_first(recipe.x_t_shape, schedule=schedule, seed=seed, sample_indices=(0,))
    x_t = torch.from_numpy(first).expand(rows, *recipe.x_t_shape)
    x0 = x_t
    num_steps = recipe.default_steps or schedule.num_steps
    chain = timesteps(schedule.num_steps, num_steps, plan=recipe.plan)
    for step, (t, after) in enumerate(zip_longest(chain, chain[1:])):
        timestep = torch.full((rows,), t)
        x0 = _run(denoiser, {**tensors, "x_t": x_t, "timestep": timestep})["x0"]
        (drawn,) = noise(recipe.x_t_shape, seed=seed, sample_indices=(0,), draw=step + 1)
        clean = after is None
        x_t = ddim_step(
            x_t=x_t,
            x0=x0,
            alpha_bar=float(schedule.alpha_bar[t]),
            variance=_along_rows(schedule.variance[t], x_t),
            alpha_bar_next=1.0 if clean else float(schedule.alpha_bar[after]),
            variance_next=_along_rows(
                np.zeros_like(schedule.variance[t]) if clean else schedule.variance[after], x_t
            ),
            eta=recipe.eta,
            noise=torch.from_numpy(drawn),
        )
    return x0


def _along_rows(values: Float[np.ndarray, "N"], x_t: Tensor) -> Tensor:
    """Values of the schedule's directions, which lie along the first axis of every row."""
    return torch.tensor(values, dtype=torch.float32).reshape(-1, *[1] * (x_t.ndim - 2))


def _check_parity(
    recipe: Recipe,
    graphs: Mapping[str, Graph],
    manifest: Manifest,
    folder: Path,
    observations: Float[np.ndarray, "S T J 3"],
) -> None:
    for rows in PARITY_BATCHES:
        engine = Engine(Runner(unstopped(manifest), folder), rows_per_step=rows)
        requests = [
            trial_request(recipe, observation, seed=7) for observation in observations[:rows]
        ]
        try:
            served = np.concatenate([result.futures for result in engine.run(requests)])
        except EngineError as error:
            raise ExportError(f"parity: at batch {rows}: {error}") from error
        expected = reference_futures(recipe, graphs, observations[:rows], seed=7)
        worst = float(np.abs(served - expected).max())
        if not worst <= PARITY_M:
            raise ExportError(
                f"parity: torch and onnxruntime differ by {worst:.2e} m at batch {rows}; "
                f"they must agree to {PARITY_M:.0e} m."
            )
