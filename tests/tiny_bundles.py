"""Tiny real bundles, and a person who walks."""

import io
import warnings
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np
import torch

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
from models.diffusion import cosine_schedule
from models.motion.kinematics import bone_lengths, fit_bone_lengths
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, Skeleton

NUM_OBSERVED, HORIZON, NUM_JOINTS, FPS, NUM_STEPS = 15, 60, 21, 30.0, 10
X_T_SHAPE = (4, 3)

OBSERVATION = TensorSpec(name="observation", shape=("B", NUM_OBSERVED, NUM_JOINTS, 3))
CONTEXT = TensorSpec(name="context", shape=("B", 12))
X_T = TensorSpec(name="x_t", shape=("B", *X_T_SHAPE))
TIMESTEP = TensorSpec(name="timestep", shape=("B",), dtype="int64")
X0 = TensorSpec(name="x0", shape=("B", *X_T_SHAPE))
FUTURE = TensorSpec(name="future", shape=("B", HORIZON, NUM_JOINTS, 3))

LABELS, CHUNK_FRAMES, MIN_FRAMES, NOISE_SHAPE = ("reach", "crouch", "wave"), 8, 6, (2,)
ACTION = TensorSpec(name="action", shape=("B",), dtype="int64")
NOISE = TensorSpec(name="noise", shape=("B", *NOISE_SHAPE))
PACE = TensorSpec(name="pace", shape=("B", *NOISE_SHAPE))
GOAL = TensorSpec(name="goal", shape=("B", NUM_JOINTS, 3))
POSE = TensorSpec(name="pose", shape=("B", NUM_JOINTS, 3))
NEXT_POSE = TensorSpec(name="next_pose", shape=("B", NUM_JOINTS, 3))
EARLIEST_END = TensorSpec(name="earliest_end", shape=("B", 1))
CHUNK = TensorSpec(name="future", shape=("B", CHUNK_FRAMES, NUM_JOINTS, 3))


class Encoder(torch.nn.Module):
    """Features of the motion; a body that moves by more than 30 m along x makes them NaN."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(NUM_JOINTS * 3, 12)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        motion = (observation[:, -1] - observation[:, 0]).flatten(1)
        return torch.tanh(self.linear(motion)) * torch.sqrt(30.0 - motion[:, :1]) / 5.0


class Denoiser(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.time = torch.nn.Embedding(NUM_STEPS, 8)
        self.net = torch.nn.Sequential(
            torch.nn.Linear(12 + 12 + 8, 32), torch.nn.SiLU(), torch.nn.Linear(32, 12)
        )

    def forward(
        self, x_t: torch.Tensor, timestep: torch.Tensor, context: torch.Tensor
    ) -> torch.Tensor:
        joined = torch.cat([x_t.flatten(1), self.time(timestep), context], dim=1)
        return self.net(joined).reshape(-1, *X_T_SHAPE).clamp(-3.0, 3.0)


class Decoder(torch.nn.Module):
    """The last pose, and a drift that grows from nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.linear = torch.nn.Linear(12 + 12, NUM_JOINTS * 3)
        self.register_buffer("ramp", torch.linspace(1.0 / HORIZON, 1.0, HORIZON))

    def forward(
        self, x0: torch.Tensor, context: torch.Tensor, observation: torch.Tensor
    ) -> torch.Tensor:
        drift = self.linear(torch.cat([x0.flatten(1), context], 1)).reshape(-1, 1, NUM_JOINTS, 3)
        return observation[:, -1:] + 0.2 * drift * self.ramp[None, :, None, None]


class ActionEncoder(torch.nn.Module):
    """Where an action leads and the pose that it starts from; NaN for a body that is too fast."""

    def __init__(self) -> None:
        super().__init__()
        self.motion = Encoder()
        self.linear = torch.nn.Linear(12, NUM_JOINTS * 3)
        self.reach = torch.nn.Embedding(len(LABELS), NUM_JOINTS * 3)

    def forward(
        self, observation: torch.Tensor, action: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        pose = observation[:, -1]
        reach = self.reach(action) + 0.1 * self.linear(self.motion(observation))
        return pose + 0.5 * reach.reshape(-1, NUM_JOINTS, 3), pose


class PacedEncoder(ActionEncoder):
    """The same, and a pace for the decoder: the noise where it is given, else none."""

    def forward(
        self, observation: torch.Tensor, action: torch.Tensor, *noise: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        still = 0.0 * observation[:, 0, 0, :2]
        return *super().forward(observation, action), noise[0] + still if noise else still


class ActionDecoder(torch.nn.Module):
    """The next frames of a body that comes to rest at its goal, and the last of them.

    Every frame is nearer to the goal by a factor that the pace decides.
    """

    def __init__(self, *, earliest_end: float | None = None) -> None:
        super().__init__()
        self.earliest_end = earliest_end
        self.register_buffer("times", torch.arange(1.0, CHUNK_FRAMES + 1))

    def forward(
        self, pace: torch.Tensor, goal: torch.Tensor, pose: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        left = 0.88 + 0.06 * torch.tanh(pace[:, :1])
        left = (left**self.times)[:, :, None, None]
        future = goal[:, None] + left * (pose - goal)[:, None]
        said = () if self.earliest_end is None else (0.0 * left[:, 0, 0] + self.earliest_end,)
        return future, future[:, -1], *said


class LastPose(torch.nn.Module):
    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return observation[:, -1:].expand(-1, HORIZON, -1, -1).contiguous()


def exported(
    module: torch.nn.Module,
    file: str,
    *,
    inputs: tuple[TensorSpec, ...],
    outputs: tuple[TensorSpec, ...],
) -> tuple[GraphSpec, bytes]:
    dummies = tuple(
        torch.zeros([2, *spec.shape[1:]], dtype=getattr(torch, spec.dtype)) for spec in inputs
    )
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of its own successor
        torch.onnx.export(
            module.eval(),
            dummies,
            buffer,
            dynamo=False,
            opset_version=17,
            input_names=[spec.name for spec in inputs],
            output_names=[spec.name for spec in outputs],
            dynamic_axes={spec.name: {0: "B"} for spec in (*inputs, *outputs)},
        )
    content = buffer.getvalue()
    digest = sha256(content).hexdigest()
    return GraphSpec(file=file, sha256=digest, inputs=inputs, outputs=outputs), content


def seeded(make: Callable[[], torch.nn.Module], seed: int) -> torch.nn.Module:
    module = make()
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.4)
    return module


def write(folder: Path, graphs: dict[str, tuple[GraphSpec, bytes]], **fields: object) -> Path:
    manifest = Manifest(
        name=folder.name,
        version="1.0.0",
        system="made-by-a-test",
        description="A tiny bundle.",
        licence="CC0-1.0",
        skeleton=SkeletonSpec(name=BODY21.name, joints=BODY21.joints, parents=BODY21.parents),
        fps=FPS,
        num_observed=NUM_OBSERVED,
        horizon=HORIZON,
        symmetries=("translation",),
        **{role: graph for role, (graph, _) in graphs.items()},  # type: ignore[arg-type]
        **fields,  # type: ignore[arg-type]
    )
    files = {graph.file: content for graph, content in graphs.values()}
    write_bundle(folder, manifest, files | {CARD_FILE: b"# A tiny bundle\n"})
    return folder


def write_still_bundle(folder: Path) -> Path:
    """A bundle without a denoiser: every future is the last pose."""
    decoder = exported(LastPose(), "decoder.onnx", inputs=(OBSERVATION,), outputs=(FUTURE,))
    return write(folder, {"decoder": decoder})


def write_diffusion_bundle(folder: Path, *, eta: float = 0.0, directions: int = 1) -> Path:
    """A bundle of three graphs with fixed random weights and K = 10."""
    schedule = cosine_schedule(NUM_STEPS)
    stretch = np.linspace(1.0, 0.5, directions)
    spec = ScheduleSpec(
        alpha_bar=tuple(schedule.alpha_bar),
        variance=tuple(map(tuple, schedule.variance * stretch)),
        eta=eta,
    )
    graphs = {
        "encoder": exported(
            seeded(Encoder, 1), "encoder.onnx", inputs=(OBSERVATION,), outputs=(CONTEXT,)
        ),
        "denoiser": exported(
            seeded(Denoiser, 2), "denoiser.onnx", inputs=(X_T, TIMESTEP, CONTEXT), outputs=(X0,)
        ),
        "decoder": exported(
            seeded(Decoder, 3), "decoder.onnx", inputs=(X0, CONTEXT, OBSERVATION), outputs=(FUTURE,)
        ),
    }
    return write(folder, graphs, schedule=spec, x_t_shape=X_T_SHAPE)


def write_actions_bundle(
    folder: Path, *, draws: str | None = "decoder", earliest_end: float | None = None
) -> Path:
    """A bundle that performs `LABELS`; its decoder, its encoder or no graph asks for noise.

    The decoder may say the ``earliest_end`` of every action.
    """
    if draws == "decoder":
        encoder, pace, inputs, outputs = ActionEncoder, NOISE, (), ()
    else:
        encoder, pace, outputs = PacedEncoder, PACE, (PACE,)
        inputs = (NOISE,) if draws else ()
    graphs = {
        "encoder": exported(
            seeded(encoder, 4),
            "encoder.onnx",
            inputs=(OBSERVATION, ACTION, *inputs),
            outputs=(GOAL, POSE, *outputs),
        ),
        "decoder": exported(
            ActionDecoder(earliest_end=earliest_end),
            "decoder.onnx",
            inputs=(pace, GOAL, POSE),
            outputs=(CHUNK, NEXT_POSE, *(() if earliest_end is None else (EARLIEST_END,))),
        ),
    }
    actions = ActionsSpec(
        labels=LABELS,
        examples={"wave": "raises a hand"},
        chunk_frames=CHUNK_FRAMES,
        min_frames=MIN_FRAMES,
        stop_threshold_m=0.02,
    )
    return write(folder, graphs, actions=actions, x_t_shape=NOISE_SHAPE)


# Rest pose of a person of 1.75 m who faces +X, hips at the origin.
_HALF = {
    "shoulder": (0.0, 0.03, 0.42), "upper_arm": (0.0, 0.18, 0.42), "lower_arm": (0.02, 0.2, 0.14),
    "hand": (0.06, 0.22, -0.1), "upper_leg": (0.0, 0.09, -0.05), "lower_leg": (0.02, 0.1, -0.47),
    "foot": (-0.02, 0.1, -0.88), "toes": (0.12, 0.11, -0.94),
}  # fmt: skip
_MIDDLE = {
    "hips": (0.0, 0.0, 0.0), "spine": (0.0, 0.0, 0.1), "chest": (-0.01, 0.0, 0.25),
    "neck": (0.0, 0.0, 0.48), "head": (0.03, 0.0, 0.58),
}  # fmt: skip


def standing_pose() -> np.ndarray:
    """(21, 3) metres, a person facing +X on the ground."""
    rows = []
    for joint in BODY21.joints:
        side, _, part = joint.partition("_")
        x, y, z = _MIDDLE[joint] if joint in _MIDDLE else _HALF[part]
        rows.append((x, -y if side == "right" else y, z + 0.96))
    return np.array(rows)


def walking(num_frames: int = NUM_OBSERVED, *, fps: float = FPS, speed: float = 1.2) -> np.ndarray:
    """(T, 21, 3) metres: a rigid person walks along +X until time 0, arms and legs swinging."""
    times = np.arange(1 - num_frames, 1) / fps
    poses = np.repeat(standing_pose()[None], num_frames, axis=0)
    poses[:, :, 0] += speed * times[:, None]
    for joint, name in enumerate(BODY21.joints):
        reach = {"left": 0.25, "right": -0.25}.get(name.split("_")[0], 0.0)
        depth = np.clip(0.96 - standing_pose()[joint, 2], 0.0, 1.0)
        poses[:, joint, 0] += reach * depth * np.sin(2 * np.pi * times)
    lengths = bone_lengths(standing_pose(), BODY21.parents)
    return np.ascontiguousarray(fit_bone_lengths(poses, lengths, BODY21.parents))


def walking_in_a_scene(num_frames: int, *, name: str, away_m: float = 0.0) -> Motion:
    """The same person under a joint that stands at the origin, as animation files have it."""
    parents = (-1, *(parent + 1 for parent in BODY21.parents))
    skeleton = Skeleton(name="scene", joints=("joint_Root", *BODY21.joints), parents=parents)
    body = walking(num_frames) + np.array([away_m, 0.0, 0.0])
    positions = np.concatenate([np.zeros((num_frames, 1, 3)), body], axis=1)
    return Motion(name=name, skeleton=skeleton, positions=positions, fps=FPS)
