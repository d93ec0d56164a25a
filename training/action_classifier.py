"""The action recognition network that judges predicted actions (Mao et al. 2022, supplement 10).

A GRU over the frames and an MLP. It sees velocities in the heading of the first frame, so neither
where a person is nor how they stand tells it the action: held-out styles stand as those of other
actions do. In training a share of the features is hidden, and tempo varies more than in life. As
predicted actions do, those that it learns from follow another one as often as the recipe says: one
that has seen no such pair names the action that it saw first.
"""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence

from models.motion.skeleton import Skeleton
from models.pose import WorldPoses
from models.system import Batch, Data, Graph, Losses, Recipe, Stage
from training.data.batches import described_data
from training.data.store import Store
from training.loop import RECIPE_FILE, RunError, finished_weights

HIDDEN, WIDTHS = 128, (300, 200)
SAMPLES_PER_S = 10.0
"""Frames that the network looks at; of 30 fps every third one."""
USUAL_SPEED = 2.0
"""Metres per second that count as one."""
SHORTEST_SHARE = 0.5
"""Of a sequence that is cut for training, as every other one is."""
HIDDEN_SHARE = 0.2
"""Of the features, hidden throughout a sequence of training."""
SLOWEST, FASTEST = 0.7, 1.4
SEQUENCES_AT_ONCE = 256


class ActionClassifier(nn.Module):
    """Names the action of a motion of any length."""

    def __init__(self, *, skeleton: Skeleton, fps: float, num_labels: int) -> None:
        super().__init__()
        self._representation = WorldPoses(skeleton, root_weight=1.0)
        self._stride = max(1, round(fps / SAMPLES_PER_S))
        self._scale = fps / self._stride / USUAL_SPEED
        self.num_inputs = self._representation.num_features
        self.recurrent = nn.GRU(self.num_inputs, HIDDEN, batch_first=True)
        wide, narrow = WIDTHS
        self.perceptron = nn.Sequential(
            nn.Linear(HIDDEN, wide), nn.ReLU(), nn.Linear(wide, narrow), nn.ReLU()
        )
        self.head = nn.Linear(narrow, num_labels)

    def features(
        self,
        poses: Float[Tensor, "B L J 3"],
        length: Int[Tensor, "B"],
        *,
        weights: Float[Tensor, "B D"] | None = None,
    ) -> Float[Tensor, "B F"]:
        """What the last ReLU gives for the first ``length`` frames, of which `fid` is taken.

        ``weights`` of the inputs, the same at every frame, are 1 unless it is trained.
        """
        seen = self._inputs(poses[:, : int(length.max()) : self._stride])
        if weights is not None:
            seen = seen * weights[:, None]
        steps = (length - 1) // self._stride + 1
        packed = pack_padded_sequence(seen, steps.cpu(), batch_first=True, enforce_sorted=False)
        _, state = self.recurrent(packed)
        return self.perceptron(state[0])

    def _inputs(self, poses: Float[Tensor, "B L J 3"]) -> Float[Tensor, "B L D"]:
        """Velocities of the root, and of the joints around it; 0 at the first frame."""
        features = self._representation.enter(poses[:, :1], poses)
        return torch.diff(features, dim=1, prepend=features[:, :1]) * self._scale


def classifier_recipe(recipe: Recipe, *, num_updates: int = 1_000) -> Recipe:
    """How the classifier is trained on the clips from which a recipe learns its actions.

    Raises:
        RunError: the recipe learns no actions.
    """
    actions = recipe.data.actions
    if actions is None:
        raise RunError(f"recipe: {recipe.name} learns no actions; choose one that has labels.")
    return Recipe(
        name=f"{recipe.name}_classifier",
        system="action-classifier",
        description="Names the actions of motions, to judge those that are predicted.",
        data=dataclasses.replace(
            recipe.data,
            augmentation=dataclasses.replace(
                recipe.data.augmentation, slowest=SLOWEST, fastest=FASTEST
            ),
        ),
        build=partial(
            ActionClassifier,
            skeleton=recipe.data.skeleton,
            fps=recipe.data.fps,
            num_labels=len(actions.labels),
        ),
        graphs=no_graphs,
        stages=(
            Stage(
                name="classifier",
                loss=recognition_loss,
                trains=("recurrent", "perceptron", "head"),
                num_updates=num_updates,
                batch_size=64,
                learning_rate=2e-3,
                warmup=min(50, num_updates),
                weight_decay=1e-2,
                gradient_clip=1.0,
            ),
        ),
    )


def no_graphs(network: nn.Module) -> tuple[Graph, ...]:
    """None: a classifier judges and is not served."""
    del network
    return ()


def recognition_loss(network: ActionClassifier, batch: Batch, generator: Generator) -> Losses:
    """Cross-entropy of the label; the tail of every other sequence is cut off somewhere."""
    poses = torch.cat([batch["observation"], _with_transition(batch)], dim=1)
    rows, device = len(poses), poses.device
    whole = batch["observation"].shape[1] + batch["length"]
    draws = torch.rand(2, rows, generator=generator, device=device)
    kept = torch.where(draws[0] < 0.5, SHORTEST_SHARE + (1 - SHORTEST_SHARE) * draws[1], 1.0)
    shown = torch.rand(rows, network.num_inputs, generator=generator, device=device) > HIDDEN_SHARE
    features = network.features(
        poses, (kept * whole).ceil().long(), weights=shown / (1 - HIDDEN_SHARE)
    )
    logits = network.head(features)
    right = (logits.argmax(dim=1) == batch["action"]).float().mean()
    return {"total": nn.functional.cross_entropy(logits, batch["action"]), "accuracy": right}


def _with_transition(batch: Batch) -> Float[Tensor, "B L J 3"]:
    """The futures, straight from the last observed pose to the first that is known."""
    future, first = batch["future"], batch["first"][:, None]
    frame = torch.arange(future.shape[1], device=future.device)
    gone = ((frame + 1) / (first + 1)).clamp(max=1.0)[..., None, None]
    return torch.lerp(batch["observation"][:, -1:], future, gone)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Judge:
    """A trained classifier, and what its run says of the actions and where they are found."""

    network: ActionClassifier
    labels: Mapping[str, tuple[str, ...]]
    """Selectors of clips by label, in the order of the labels' indices."""
    data: Data

    @torch.no_grad()
    def __call__(
        self, sequences: Sequence[Float[np.ndarray, "_ J 3"]]
    ) -> tuple[Float[np.ndarray, "B F"], Int[np.ndarray, "B"]]:
        """Features and index of the label of each sequence, in metres."""
        features, labels = [], []
        for first in range(0, len(sequences), SEQUENCES_AT_ONCE):
            mine = sequences[first : first + SEQUENCES_AT_ONCE]
            length = torch.tensor([len(sequence) for sequence in mine])
            tensors = [torch.from_numpy(np.asarray(one, np.float32)) for one in mine]
            poses = nn.utils.rnn.pad_sequence(tensors, batch_first=True)
            features.append(self.network.features(poses, length))
            labels.append(self.network.head(features[-1]).argmax(dim=1))
        return torch.cat(features).numpy(), torch.cat(labels).numpy()


def read_judge(folder: Path, store: Store) -> Judge:
    """The classifier of a finished run.

    Raises:
        CheckpointError: there is no checkpoint.
        RunError: the run is not finished, is not of a classifier, or does not fit the store.
    """
    weights = finished_weights(folder, torch.device("cpu"))
    said = json.loads((folder / RECIPE_FILE).read_text())["data"]
    if not said.get("actions") or "head.weight" not in weights:
        raise RunError(f"{folder}: found a run of another kind; must be one of classifier.")
    found = (tuple(said["skeleton"]["joints"]), said["fps"])
    if found != (store.skeleton.joints, store.fps):
        raise RunError(
            f"{folder}: found {said['skeleton']['name']} at {said['fps']:g} fps; the store holds "
            f"{store.skeleton.name} at {store.fps:g} fps."
        )
    labels = {label: tuple(selectors) for label, selectors in said["actions"]["labels"].items()}
    network = ActionClassifier(skeleton=store.skeleton, fps=store.fps, num_labels=len(labels))
    network.load_state_dict(weights)
    data = described_data(said, store, num_observed=said["num_observed"], horizon=said["horizon"])
    return Judge(network=network.eval(), labels=labels, data=data)
