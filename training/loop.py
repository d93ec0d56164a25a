"""The one training loop: every stage of every system."""

import dataclasses
import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from models.system import Batch, Data, Losses, Recipe, Stage, describe
from training.checkpoint import CHECKPOINT_FILE, load_checkpoint, save_checkpoint
from training.data.action_batches import ActionBatches
from training.data.batch_source import BatchSource
from training.data.batches import Batches
from training.data.store import Store

RECIPE_FILE = "recipe.json"
SECONDS_BETWEEN_CHECKPOINTS = 60.0
UPDATES_BETWEEN_REPORTS = 50


class RunError(Exception):
    """A run folder does not fit what it is asked to continue."""


@dataclass(kw_only=True, slots=True)
class Progress:
    """How far a run is; part of its checkpoint."""

    stage: int = 0
    update: int = 0
    total_updates: int = 0
    seconds: float = 0.0


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """A recipe in training, in its folder."""

    recipe: Recipe
    folder: Path
    network: nn.Module
    device: torch.device
    batches: BatchSource
    seed: int
    progress: Progress


def train(
    recipe: Recipe,
    store: Store,
    folder: Path,
    *,
    device: torch.device,
    seed: int = 0,
    start_from: Path | None = None,
) -> nn.Module:
    """Train all stages of a recipe, continuing the run in the folder if there is one.

    Args:
        recipe: what to train.
        store: what to learn from.
        folder: where checkpoints, TensorBoard's files and the recipe go.
        device: where to compute.
        seed: of weights, windows and noise.
        start_from: folder of another run of the same network whose weights a new run starts with.

    Raises:
        RunError: the folder holds a run of another recipe.
        CheckpointError: its checkpoint is damaged.
        StoreError: the store does not fit the recipe.
    """
    torch.manual_seed(seed)
    _claim(recipe, folder)
    state = load_checkpoint(folder, device) if (folder / CHECKPOINT_FILE).exists() else None
    run = Run(
        recipe=recipe,
        folder=folder,
        network=recipe.build().to(device),
        device=device,
        batches=batches_of(store, recipe.data, seed=seed),
        seed=seed,
        progress=Progress(**state["progress"]) if state else Progress(),
    )
    if state:
        run.network.load_state_dict(state["network"])
    elif start_from:
        run.network.load_state_dict(finished_weights(start_from, device))
    writer = SummaryWriter(str(folder / "tensorboard"))
    for index in range(run.progress.stage, len(recipe.stages)):
        resumed = state if state and state["progress"]["stage"] == index else None
        _run_stage(run, recipe.stages[index], writer, resumed)
        run.progress.stage, run.progress.update = index + 1, 0
        _save(run, None, None)
    writer.close()
    return run.network.eval()


def batches_of(store: Store, data: Data, *, seed: int) -> BatchSource:
    """Whole actions where a recipe asks for them, else windows.

    Raises:
        StoreError: the store does not fit the recipe.
    """
    return (ActionBatches if data.actions else Batches)(store, data, seed=seed)


def trained_network(recipe: Recipe, folder: Path | None) -> tuple[nn.Module, Progress]:
    """The network of a finished run, on the CPU; what needs no training needs no run.

    Raises:
        CheckpointError: there is no checkpoint.
        RunError: the run is of another recipe or is not finished.
    """
    if not recipe.stages:
        return recipe.build().eval(), Progress()
    if folder is None:
        raise RunError(f"run: {recipe.name} is trained; name the folder of its finished run.")
    state = load_checkpoint(folder, torch.device("cpu"))
    progress = Progress(**state["progress"])
    if progress.stage < len(recipe.stages):
        raise RunError(
            f"{folder}: the run stands in stage {recipe.stages[progress.stage].name}; "
            "finish it with the train command before it is exported."
        )
    network = recipe.build()
    network.load_state_dict(state["network"])
    return network.eval(), progress


def finished_weights(folder: Path, device: torch.device) -> dict[str, Tensor]:
    """The weights of a finished run.

    Raises:
        CheckpointError: there is no checkpoint.
        RunError: the run is not finished.
    """
    state = load_checkpoint(folder, device)
    if "optimiser" in state:
        raise RunError(f"{folder}: this run is not finished; run its own command again first.")
    weights: dict[str, Tensor] = state["network"]
    return weights


def _claim(recipe: Recipe, folder: Path) -> None:
    written = json.dumps(describe(recipe), indent=1)
    path = folder / RECIPE_FILE
    if path.exists() and path.read_text() != written:
        raise RunError(
            f"{path}: the folder holds a run of another recipe or of other settings; "
            "choose another folder, or delete this one."
        )
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(written)


def _run_stage(
    run: Run, stage: Stage, writer: SummaryWriter, resumed: dict[str, Any] | None
) -> None:
    learning = _only_these_learn(run.network, stage)
    optimiser = _optimiser(run.network, stage)
    averaged = [p.detach().clone() for p in learning] if stage.ema_decay else []
    generator = torch.Generator(run.device)
    if resumed and "optimiser" in resumed:
        optimiser.load_state_dict(resumed["optimiser"])
        averaged = resumed["averaged"]
    elif stage.prepare:
        first = iter(range(2**30, 2**31))  # batch numbers that no stage learns from
        stage.prepare(
            run.network,
            lambda: _on(run.device, run.batches.batch(next(first), stage.batch_size)),
        )
    bar = tqdm(
        total=stage.num_updates, initial=run.progress.update, desc=stage.name, mininterval=2.0
    )
    started = saved = time.monotonic()
    stream = run.batches.stream(first=run.progress.total_updates, size=stage.batch_size)
    for update in range(run.progress.update, stage.num_updates):
        # Seeded by its number, so that a resumed run draws what an uninterrupted one would.
        generator.manual_seed(_seed_of(run.seed, run.progress.total_updates))
        _set_rates(optimiser, stage, update)
        losses = stage.loss(run.network, _on(run.device, next(stream)), generator)
        _learn(optimiser, learning, losses, stage)
        if stage.ema_decay:
            _average(averaged, learning, min(stage.ema_decay, (1 + update) / (10 + update)))
        run.progress.update += 1
        run.progress.total_updates += 1
        bar.update()
        if update % UPDATES_BETWEEN_REPORTS == 0:
            _report(run, stage, losses, bar, writer)
        if time.monotonic() - saved > SECONDS_BETWEEN_CHECKPOINTS:
            run.progress.seconds += time.monotonic() - started
            started = saved = time.monotonic()
            _save(run, optimiser, averaged)
    stream.close()
    bar.close()
    run.progress.seconds += time.monotonic() - started
    with torch.no_grad():
        for parameter, mean in zip(learning, averaged, strict=False):
            parameter.copy_(mean)


def _seed_of(seed: int, update: int) -> int:
    # torch's generator on the CPU looks at 32 bits alone.
    return int(np.random.SeedSequence([seed, update]).generate_state(1)[0])


def _only_these_learn(network: nn.Module, stage: Stage) -> list[nn.Parameter]:
    network.train()
    network.requires_grad_(False)
    for name in stage.trains:
        network.get_submodule(name).requires_grad_(True)
    return [parameter for parameter in network.parameters() if parameter.requires_grad]


def _optimiser(network: nn.Module, stage: Stage) -> torch.optim.Optimizer:
    groups = [
        {
            "params": list(network.get_submodule(name).parameters()),
            "rate": stage.learning_rates.get(name, stage.learning_rate),
        }
        for name in stage.trains
    ]
    return torch.optim.AdamW(
        groups, weight_decay=stage.weight_decay, amsgrad=stage.amsgrad, fused=True
    )


def _set_rates(optimiser: torch.optim.Optimizer, stage: Stage, update: int) -> None:
    progress = update / stage.num_updates
    factor = stage.decay(progress) if stage.decay else 0.5 + 0.5 * math.cos(math.pi * progress)
    warm = min(1.0, (update + 1) / stage.warmup) if stage.warmup else 1.0
    for group in optimiser.param_groups:
        group["lr"] = group["rate"] * factor * warm


def _learn(
    optimiser: torch.optim.Optimizer,
    learning: list[nn.Parameter],
    losses: Losses,
    stage: Stage,
) -> None:
    optimiser.zero_grad(set_to_none=True)
    losses["total"].backward()
    if stage.gradient_clip:
        nn.utils.clip_grad_norm_(learning, stage.gradient_clip)
    optimiser.step()


@torch.no_grad()
def _average(averaged: list[Tensor], learning: list[nn.Parameter], decay: float) -> None:
    torch._foreach_lerp_(averaged, [p.detach() for p in learning], 1 - decay)


def _report(run: Run, stage: Stage, losses: Losses, bar: Any, writer: SummaryWriter) -> None:
    values = {name: float(value.detach()) for name, value in losses.items()}
    if not all(math.isfinite(value) for value in values.values()):
        raise RunError(
            f"{stage.name}, update {run.progress.update}: found the losses {values}; "
            "a run that diverged cannot go on, lower the learning rate."
        )
    bar.set_postfix({name: f"{value:.4g}" for name, value in values.items()}, refresh=False)
    for name, value in values.items():
        writer.add_scalar(f"{stage.name}/{name}", value, run.progress.update)


def _save(run: Run, optimiser: torch.optim.Optimizer | None, averaged: list[Tensor] | None) -> None:
    state: dict[str, Any] = {
        "network": run.network.state_dict(),
        "progress": dataclasses.asdict(run.progress),
    }
    if optimiser:
        state |= {"optimiser": optimiser.state_dict(), "averaged": averaged}
    save_checkpoint(run.folder, state)


def _on(device: torch.device, batch: Batch) -> Batch:
    return {name: value.to(device) for name, value in batch.items()}
