"""What goes over HTTP, for validation and for the OpenAPI document."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Discriminator,
    Field,
    InstanceOf,
    Tag,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import PydanticCustomError

from models.motion.axes import UNITS_PER_METRE, Axes, Handed, Units, Up
from models.motion.gaps import MIN_CONFIDENCE
from models.motion.standards import STANDARDS
from service.answers.occupancy import LEVELS, MAX_MARGIN_M, MAX_REGIONS, Box, Capsule, Query, Region
from service.answers.quantiles import DEFAULT_LEVELS
from service.engine.trajectory import StoppedBy
from service.example import ACTIONS_EXAMPLE, EXAMPLE
from service.futures import BoneLengths
from service.observation import MAX_FPS, MIN_FPS, Source
from service.poses.skeletons import OwnJoints
from service.poses.stance import About

MAX_SEED = 2**53 - 1  # the largest integer that every JSON reader keeps
MAX_ACTIONS = 16
MAX_STOP_THRESHOLD_M = 1.0
MAX_STREAM_HZ = 60.0
MAX_COORDINATE = 1e7

_POSES_SCHEMA = {
    "type": "array",
    "description": "[frames][joints][x, y, z]; the last frame is now. A joint not seen is null.",
    "items": {
        "type": "array",
        "items": {
            "anyOf": [
                {
                    "type": "array",
                    "items": {"type": "number"},
                    "minItems": 3,
                    "maxItems": 3,
                },
                {"type": "null"},
            ]
        },
    },
}


class _Body(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class SkeletonBody(_Body):
    """Joints under the caller's own names."""

    joints: list[str] = Field(
        min_length=8, max_length=256, description="names, in the order of the poses"
    )
    map: dict[str, str] | None = Field(
        default=None, description="{own joint: joint of body21}; by default names are recognised"
    )
    parents: list[int] | None = Field(
        default=None, description="index of each joint's parent, -1 for the root"
    )

    def own_joints(self) -> OwnJoints:
        """The same as the service uses it."""
        parents = None if self.parents is None else tuple(self.parents)
        return OwnJoints(joints=tuple(self.joints), mapping=self.map, parents=parents)


def _listed(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray) else value


def _kind(skeleton: object) -> str | None:
    if isinstance(skeleton, dict | SkeletonBody):
        return "own"
    return "name" if isinstance(skeleton, str) else None


SkeletonField = Annotated[
    Annotated[str, Tag("name")] | Annotated[SkeletonBody, Tag("own")],
    Discriminator(
        _kind,
        custom_error_type="skeleton",
        custom_error_message='must be a name, or {"joints": [...], "map": {...}}',
    ),
]


class AxesBody(_Body):
    """The caller's coordinates."""

    up: Up = Field(default="z", description="the axis that points up")
    units: Units = "m"
    handed: Handed = Field(default="right", description="left as in Unity and Unreal")

    def axes(self) -> Axes:
        """The same as the service uses it."""
        return Axes(up=self.up, units=self.units, handed=self.handed)


_Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]
_Length = Annotated[float, Field(ge=0, le=MAX_COORDINATE)]
_Point = Annotated[list[_Coordinate], Field(min_length=3, max_length=3), BeforeValidator(_listed)]


class BoxBody(_Body):
    """A box in the caller's axes and units, half of its size to each side of its centre."""

    center: _Point
    size: Annotated[list[_Length], Field(min_length=3, max_length=3), BeforeValidator(_listed)] = (
        Field(description="along its own x, y and z, which are the caller's where yaw is 0")
    )
    yaw: float = Field(default=0.0, allow_inf_nan=False, description="radians about up")

    def region(self, axes: Axes) -> Region:
        """The same as the service uses it."""
        return Box(
            centre=axes.to_metres(np.array(self.center)),
            size=np.abs(axes.to_metres(np.array(self.size))),
            yaw=self.yaw,
        )


class CapsuleBody(_Body):
    """All within a radius of a line, in the caller's axes and units; a ball if its ends are one."""

    start: _Point
    end: _Point
    radius: _Length

    def region(self, axes: Axes) -> Region:
        """The same as the service uses it."""
        return Capsule(
            start=axes.to_metres(np.array(self.start)),
            end=axes.to_metres(np.array(self.end)),
            radius=self.radius / UNITS_PER_METRE[axes.units],
        )


class RegionBody(_Body):
    """A box or a capsule."""

    box: BoxBody | None = None
    capsule: CapsuleBody | None = None

    @model_validator(mode="after")
    def _one(self) -> "RegionBody":
        if (self.box is None) == (self.capsule is None):
            raise PydanticCustomError("region", 'must be {"box": ...} or {"capsule": ...}')
        return self


class OccupancyBody(_Body):
    """Where a robot is or will be, and how near is too near."""

    regions: list[RegionBody] = Field(min_length=1, max_length=MAX_REGIONS)
    margin_m: float = Field(
        default=0.0,
        ge=0,
        le=MAX_MARGIN_M,
        description="metres: a joint or bone, which has no width, that is at most so far from a "
        "region is in it",
    )
    levels: list[Annotated[float, Field(gt=0, lt=1)]] = Field(
        default=list(LEVELS), min_length=1, max_length=16, description="of the quantiles"
    )

    def query(self, axes: Axes) -> Query:
        """The same as the service uses it."""
        solids = [region.box or region.capsule for region in self.regions]
        return Query(
            regions=tuple(solid.region(axes) for solid in solids if solid),
            margin_m=self.margin_m,
            levels=tuple(self.levels),
        )


def _usual_axes(fields: dict[str, Any]) -> AxesBody:
    """Those in which a standard skeleton usually comes."""
    name = fields.get("skeleton")
    standard = STANDARDS.get(name) if isinstance(name, str) else None
    axes = standard.axes if standard else Axes()
    return AxesBody(up=axes.up, units=axes.units, handed=axes.handed)


class ObservedPoses(_Body):
    """Poses, and all that is to be known of them."""

    poses: Annotated[list[Any] | InstanceOf[np.ndarray], WithJsonSchema(_POSES_SCHEMA)]
    skeleton: SkeletonField | None = Field(
        default=None, description="a name of GET /skeletons, or own joints; the model's by default"
    )
    axes: AxesBody = Field(
        default_factory=_usual_axes,
        description="those of GET /skeletons by default; of own joints, +Z up and metres",
    )
    fps: float | None = Field(
        default=None,
        ge=MIN_FPS,
        le=MAX_FPS,
        description="frames per second; that of the timestamps or else the model's by default",
    )
    timestamps: Annotated[
        list[Any] | None, WithJsonSchema({"type": "array", "items": {"type": "number"}})
    ] = Field(
        default=None,
        description="seconds of each frame, from any time on; they may be uneven, and the answer "
        "is at the rate fps all the same",
    )
    confidence: Annotated[
        list[Any] | InstanceOf[np.ndarray] | None,
        WithJsonSchema(
            {
                "type": "array",
                "items": {"type": "array", "items": {"type": "number", "minimum": 0, "maximum": 1}},
            }
        ),
    ] = Field(
        default=None,
        description=f"[frames][joints]; below {MIN_CONFIDENCE} a joint counts as not seen, and the "
        "less it is trusted the more it is smoothed",
    )
    model: str | None = Field(default=None, description="a name of GET /models")

    def caller_skeleton(self) -> str | OwnJoints | None:
        """The skeleton as the service uses it: a name, own joints, or none that is said."""
        if isinstance(self.skeleton, SkeletonBody):
            return self.skeleton.own_joints()
        return self.skeleton


class ObservedMotion(ObservedPoses):
    """An observed motion, and what every request may say of it and of its futures."""

    num_samples: int = Field(default=10, ge=1, description="how many futures")
    seed: int | None = Field(
        default=None, ge=0, le=MAX_SEED, description="same seed, same futures; drawn by default"
    )
    bone_lengths: BoneLengths = Field(
        default="observed",
        description="`observed` keeps the person's own; `free` is what the network said",
    )
    deadline_ms: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="after the arrival; then the answer is what is ready, as X-Request-Timeout-"
        "Seconds says it too: the smaller one counts",
    )
    occupancy: OccupancyBody | None = Field(
        default=None, description="regions to watch, where `return` names occupancy"
    )


class PredictRequest(ObservedMotion):
    """An observed motion, and how to continue it."""

    model_config = ConfigDict(json_schema_extra={"examples": [EXAMPLE]})

    num_steps: int | None = Field(
        default=None,
        ge=1,
        description="so many of the model's denoising steps: the first, or, as its `step_plan` "
        "says, an even stride over all; its `default_steps` by default",
    )
    tolerance_m: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="stop a future as soon as a step moves none of its joints by so many metres",
    )
    horizon_s: float | None = Field(
        default=None,
        gt=0,
        allow_inf_nan=False,
        description="seconds to predict; the model's by default; longer futures are rolled out "
        "from their own last frames, and a warning says so",
    )
    returned: list[Literal["futures", "modes", "quantiles", "occupancy"]] = Field(
        default=["futures"], min_length=1, alias="return", description="parts of the answer"
    )
    num_modes: int = Field(
        default=5, ge=1, description="representative futures, where modes are returned"
    )
    quantile_levels: list[Annotated[float, Field(gt=0, lt=1)]] = Field(
        default=list(DEFAULT_LEVELS),
        min_length=1,
        max_length=16,
        description="of the balls that hold a joint so often, where quantiles are returned",
    )


class PredictActionsRequest(ObservedMotion):
    """An observed motion, and the actions that the person performs next."""

    model_config = ConfigDict(json_schema_extra={"examples": [ACTIONS_EXAMPLE]})

    actions: list[str] = Field(
        min_length=1,
        max_length=MAX_ACTIONS,
        description="labels of GET /actions, performed one after the other",
    )
    stop_threshold: float | None = Field(
        default=None,
        gt=0,
        le=MAX_STOP_THRESHOLD_M,
        description="metres within which the joints stay when an action has ended; a larger one "
        "ends it sooner; the model's by default",
    )
    max_seconds_per_action: float | None = Field(
        default=None,
        gt=0,
        description="an action that has not ended by then is cut off; at most, and by default, "
        "the model's horizon",
    )
    returned: list[Literal["futures", "occupancy"]] = Field(
        default=["futures"], min_length=1, alias="return", description="parts of the answer"
    )


class FileObservation(_Body):
    """The motion of a file, in the fields of a request, and what is worth knowing of it."""

    name: str
    poses: Annotated[list[Any], WithJsonSchema(_POSES_SCHEMA)]
    skeleton: SkeletonBody
    axes: AxesBody
    fps: float
    parents: list[int] = Field(
        description="the joint from which a bone comes to each, -1 where none does: to draw it by"
    )
    start_s: float = Field(description="of the first frame in the file")
    duration_s: float = Field(description="of the whole file")


class ValidationFinding(_Body):
    """Something odd."""

    about: About
    sentence: str


class Problem(BaseModel):
    """What went wrong (RFC 9457)."""

    type: str = Field(examples=["/problems/unknown-skeleton"])
    title: str
    status: int
    detail: str = Field(description="where, what was found, what would be right")
    pointer: str | None = Field(default=None, description="the field, as a JSON pointer")
    found: str | None = None
    expected: str | None = None
    retry_after_s: float | None = Field(
        default=None, description="when to ask again, where it helps"
    )


class Validation(_Body):
    """How poses are understood, and what is odd about them."""

    predicts: bool = Field(description="whether they can be predicted from as they are")
    problem: Problem | None = Field(default=None, description="why not")
    skeleton: str
    joints: list[str]
    joint_sources: list[Source] = Field(description="of each joint, as an answer tells them")
    map: dict[str, str] = Field(description="{own joint: the joint of body21 that it is}")
    estimated: dict[str, list[str]] = Field(
        description="{joint of body21 that none is: the own joints that tell where it is}"
    )
    guessed: list[str] = Field(description="joints of body21 of which nothing is known")
    axes: AxesBody = Field(description="as they were said, or are usual for the skeleton")
    looks_like: AxesBody = Field(description="what the poses look like")
    fps: float
    findings: list[ValidationFinding]
    warnings: list[str] = Field(description="what a prediction would say beside its futures")


class ModelRef(_Body):
    """Which bundle answered."""

    name: str
    version: str
    digest: str


class Steps(_Body):
    """Denoising steps that ran, at most, of those there are."""

    run: int
    of: int
    stopped_by: StoppedBy


class Answer(_Body):
    """What every answer says beside its futures."""

    id: str
    model: ModelRef
    seed: int
    fps: float
    skeleton: str
    joints: list[str]
    joint_sources: list[Source] = Field(
        description="of each joint: `observed` in half of the frames or more, `derived` from "
        "other joints, or `imputed`: guessed, or carried over from other frames"
    )
    warnings: list[str]
    timing_ms: dict[str, float]


class Mode(_Body):
    """A future that stands for others."""

    probability: float
    sample: int = Field(description="its index among the futures")
    members: list[int] = Field(description="indices of the futures it stands for, its own included")


class Quantiles(_Body):
    """Balls about one centre, in which each joint of each frame is as often as their level says."""

    levels: list[float]
    centre: list[Any] = Field(description="[frames][joints][x, y, z]")
    radius: list[Any] = Field(description="[levels][frames][joints]")
    calibrated: bool = Field(description="whether it was measured that they hold it so often")


class Entry(_Body):
    """When futures enter a region for the first time."""

    never: float = Field(description="share of the futures that do not")
    levels: list[float]
    time_s: list[float | None] = Field(
        description="from now: by then this share of all futures has; null where fewer ever do"
    )


class Distance(_Body):
    """How near futures come to a region."""

    levels: list[float]
    distance: list[float] = Field(description="in the caller's units; 0 is within")


class Occupancy(_Body):
    """What the futures say of one region: shares of the samples, not measured probabilities.

    Samples are surer than people are, and no calibration widens them here: a region that none of
    them enters may be entered. Measured regions are those of `quantiles`, where `calibrated`.
    """

    probability: list[Any] = Field(description="[frames]: of those that last so long, in it then")
    num_lasting: list[int] = Field(description="[frames]: how many futures last so long")
    first_entry: Entry
    min_distance: Distance


class PredictResponse(Answer):
    """Futures in the caller's world, skeleton, axes, units and rate."""

    num_frames: int
    futures: Annotated[
        list[Any] | None,
        WithJsonSchema(
            {
                "type": "array",
                "description": "[samples][frames][joints][x, y, z], rounded to 0.1 mm; the first "
                "frame is one after the last observed",
                "items": _POSES_SCHEMA,
            }
        ),
    ] = None
    modes: list[Mode] | None = Field(default=None, description="the likeliest first")
    quantiles: Quantiles | None = None
    occupancy: list[Occupancy] | None = Field(default=None, description="of each region")
    steps: Steps


class StreamStart(_Body):
    """The first message of WS /stream, and any later one that asks for something else."""

    type: Literal["start"]
    session: str | None = Field(
        default=None, description="of a connection that was lost, whose frames are still there"
    )
    rate_hz: float = Field(
        default=10.0, gt=0, le=MAX_STREAM_HZ, description="answers a second, at most"
    )
    options: dict[str, Any] = Field(
        default={}, description="fields of POST /predict, without poses; a seed is drawn but once"
    )


class StreamFrame(_Body):
    """A pose, and when it was seen."""

    type: Literal["frame"]
    t: float = Field(allow_inf_nan=False, description="seconds on any clock, later each time")
    pose: list[Any] | InstanceOf[np.ndarray]
    confidence: list[Any] | InstanceOf[np.ndarray] | None = Field(
        default=None, description="[joints], as POST /predict has it for each frame"
    )


class ActionSegment(_Body):
    """The frames of a future in which one action is performed, the way into it included."""

    action: str
    start: int = Field(description="index of its first frame in the poses")
    end: int = Field(description="index after its last frame; the next action starts here")
    stopped: bool = Field(description="whether it ended; false where it was cut off")


class PerformedFuture(_Body):
    """One future, as long as its actions took."""

    num_frames: int
    poses: Annotated[
        list[Any],
        WithJsonSchema(
            _POSES_SCHEMA
            | {
                "description": "[frames][joints][x, y, z], rounded to 0.1 mm; the first frame is "
                "one after the last observed"
            }
        ),
    ]
    segments: list[ActionSegment]


class PredictActionsResponse(Answer):
    """Futures of actions in the caller's world, skeleton, axes, units and rate."""

    futures: list[PerformedFuture] | None = None
    occupancy: list[Occupancy] | None = Field(default=None, description="of each region")


class ModelSummary(_Body):
    """A bundle, and whether it can answer; the rest is null where its manifest is unreadable."""

    name: str
    state: Literal["loading", "ready", "refused"]
    reason: str | None = None
    version: str | None = None
    digest: str | None = None
    description: str | None = None
    licence: str | None = None
    attribution: list[str] = []
    skeleton: str | None = None
    joints: list[str] = []
    fps: float | None = None
    num_observed: int | None = None
    horizon: int | None = None
    num_steps: int | None = None
    default_steps: int | None = None
    step_plan: Literal["stop_early", "stride"] | None = None
    trajectory: str | None = None
    actions: list[str] = Field(
        default=[], description="labels; a model that has some answers POST /predict_actions alone"
    )


class ModelDetail(ModelSummary):
    """A bundle with its model card."""

    card: str = Field(default="", description="the model card, Markdown")
    recipe: dict[str, Any] = {}
    training: dict[str, Any] = {}


class Models(_Body):
    """The bundles of this server."""

    default: str | None
    models: list[ModelSummary]


class Action(_Body):
    """An action that can be asked for."""

    label: str
    example: str | None = Field(description="what a person does who performs it")
    models: list[str] = Field(description="the models that know it")


class Actions(_Body):
    """The actions of this server."""

    default_model: str | None = Field(description="performs them when a request names no model")
    actions: list[Action]


class StandardSkeleton(_Body):
    """A skeleton that a request may name."""

    name: str
    joints: list[str]
    parents: list[int] = Field(description="index of each joint's parent, -1 for the root")
    axes: AxesBody = Field(description="in which it is expected where a request says nothing")


class Skeletons(_Body):
    """The skeletons that a request may name."""

    skeletons: list[StandardSkeleton]


class Live(_Body):
    """The process answers."""

    status: Literal["alive"] = "alive"


class Ready(_Body):
    """Whether predictions are answered, and the state of each bundle."""

    status: Literal["loading", "ready", "unavailable", "draining"]
    default_model: str | None
    models: dict[str, str]
    golden_digests: dict[str, str] = Field(
        description="of the answer that each ready bundle gave to one and the same request; "
        "replicas whose digests are equal answer alike"
    )


class Limits(_Body):
    """What this server takes at most."""

    max_samples: int = Field(description="of one request")
    max_frames: int = Field(description="observed, of one request")
    max_poses: int = Field(description="of all futures of one answer")
    max_actions: int = Field(description="of one request")
    max_horizon_s: float
    max_body_bytes: int
    max_queued_requests: int = Field(description="under way")
    max_queued_rows: int = Field(description="samples under way, for one model")
    max_streams: int = Field(description="open at a time")
    rate_limit: str | None = Field(description="predictions of each caller")
