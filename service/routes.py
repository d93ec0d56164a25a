"""The paths of the service: each turns a request into values, and values into a response."""

import secrets
from functools import partial
from itertools import chain
from typing import Annotated

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import JSONResponse

from models.bundle import Manifest
from models.motion.skeleton import SKELETONS, Skeleton
from service import schemas
from service.actions import action_indices, max_frames
from service.answer import json_answer
from service.axes import Axes
from service.body import JsonRoute
from service.catalog import Catalog, Entry
from service.engine import trajectory
from service.errors import (
    BodyTooLargeError,
    EngineError,
    FieldError,
    MalformedBodyError,
    MediaTypeError,
    NotFoundError,
    PosesError,
    UnavailableError,
    UnknownModelError,
)
from service.futures import BoneLengths, num_frames
from service.observation import Observation, read_observation
from service.problems import declared, problem
from service.settings import Settings
from service.skeletons import OwnJoints, standard_skeleton
from service.worker import Worker

router = APIRouter(route_class=JsonRoute)


def _catalog(request: Request) -> Catalog:
    catalog: Catalog = request.app.state.catalog
    return catalog


def _settings(request: Request) -> Settings:
    settings: Settings = request.app.state.settings
    return settings


_Catalog = Annotated[Catalog, Depends(_catalog)]
_Settings = Annotated[Settings, Depends(_settings)]

_PROBLEMS = declared(
    MalformedBodyError, BodyTooLargeError, MediaTypeError, FieldError, EngineError, UnavailableError
)


@router.post(
    "/v1/predict",
    operation_id="predict_v1",
    response_model=schemas.PredictResponse,
    responses=_PROBLEMS,
)
@router.post(
    "/predict",
    operation_id="predict",
    response_model=schemas.PredictResponse,
    responses=_PROBLEMS,
)
async def predict(body: schemas.PredictRequest, catalog: _Catalog, settings: _Settings) -> Response:
    """N futures of the person in the poses, in the caller's world, skeleton and frame rate."""
    manifest, worker = catalog.ready(body.model, with_actions=False)
    _check_limits(body, settings)
    observation = _observation(body, manifest)
    request = trajectory.Request(
        observation=observation.positions,
        num_samples=body.num_samples,
        num_steps=body.num_steps,
        seed=_seed(body),
    )
    return await _answered(
        request, worker, observation, bone_lengths=body.bone_lengths, manifest=manifest
    )


@router.post(
    "/v1/predict_actions",
    operation_id="predict_actions_v1",
    response_model=schemas.PredictActionsResponse,
    responses=_PROBLEMS,
)
@router.post(
    "/predict_actions",
    operation_id="predict_actions",
    response_model=schemas.PredictActionsResponse,
    responses=_PROBLEMS,
)
async def predict_actions(
    body: schemas.PredictActionsRequest, catalog: _Catalog, settings: _Settings
) -> Response:
    """N futures of the person in the poses, who performs the actions one after the other."""
    manifest, worker = catalog.ready(body.model, with_actions=True)
    indices = action_indices(body.actions, manifest)
    longest = max_frames(body.max_seconds_per_action, manifest)
    _check_limits(body, settings)
    _check_num_poses(body, settings, manifest, frames=len(indices) * (longest or manifest.horizon))
    observation = _observation(body, manifest)
    request = trajectory.Request(
        observation=observation.positions,
        num_samples=body.num_samples,
        seed=_seed(body),
        actions=indices,
        stop_threshold_m=body.stop_threshold,
        max_frames=longest,
    )
    return await _answered(
        request, worker, observation, bone_lengths=body.bone_lengths, manifest=manifest
    )


@router.get("/actions")
async def actions(catalog: _Catalog) -> schemas.Actions:
    """The actions that can be asked for, those of the default model first."""
    default = catalog.default(with_actions=True)
    performers = catalog.performers()
    listed = [
        schemas.Action(
            label=label,
            example=next(
                (spec.examples[label] for spec in performers.values() if label in spec.examples),
                None,
            ),
            models=[name for name, spec in performers.items() if label in spec.labels],
        )
        for label in dict.fromkeys(chain(*(spec.labels for spec in performers.values())))
    ]
    return schemas.Actions(default_model=default.name if default else None, actions=listed)


@router.get("/models")
async def models(catalog: _Catalog) -> schemas.Models:
    """The bundles of this server, and which of them answers when a request names none."""
    summaries = [
        schemas.ModelSummary.model_validate(_summary(entry)) for entry in catalog.entries.values()
    ]
    return schemas.Models(default=catalog.default_model, models=summaries)


@router.get("/models/{name}", response_model=schemas.ModelDetail, responses=declared(NotFoundError))
async def model(name: str, catalog: _Catalog) -> schemas.ModelDetail | Response:
    """One bundle: its manifest in short, its digest and its model card."""
    try:
        entry = catalog.entry(name)
    except UnknownModelError as error:
        return problem(error, status=404)
    manifest = entry.manifest
    detail = _summary(entry) | {
        "card": entry.card,
        "recipe": manifest.recipe if manifest else {},
        "training": manifest.training if manifest else {},
    }
    return schemas.ModelDetail.model_validate(detail)


@router.get("/skeletons")
async def skeletons() -> schemas.Skeletons:
    """The skeletons that a request may name."""
    return schemas.Skeletons(
        skeletons=[
            schemas.StandardSkeleton(name=s.name, joints=list(s.joints), parents=list(s.parents))
            for s in SKELETONS.values()
        ]
    )


@router.get("/livez")
async def livez() -> schemas.Live:
    """The process answers."""
    return schemas.Live()


@router.get("/readyz", response_model=schemas.Ready, responses={503: {"model": schemas.Ready}})
async def readyz(catalog: _Catalog) -> Response:
    """200 once every bundle was tried and warmed up and one can answer; 503 before."""
    states = {
        name: f"{entry.state}: {entry.reason}" if entry.reason else entry.state
        for name, entry in catalog.entries.items()
    }
    ready = schemas.Ready(status=catalog.state, default_model=catalog.default_model, models=states)
    return JSONResponse(ready.model_dump(), status_code=200 if ready.status == "ready" else 503)


def _seed(body: schemas.ObservedMotion) -> int:
    return secrets.randbelow(schemas.MAX_SEED + 1) if body.seed is None else body.seed


def _observation(body: schemas.ObservedMotion, manifest: Manifest) -> Observation:
    return read_observation(
        body.poses,
        skeleton=_skeleton(body, manifest),
        axes=Axes(up=body.axes.up, units=body.axes.units),
        fps=body.fps or manifest.fps,
        manifest=manifest,
    )


async def _answered(
    request: trajectory.Request,
    worker: Worker,
    observation: Observation,
    *,
    bone_lengths: BoneLengths,
    manifest: Manifest,
) -> Response:
    content = await worker.predict(
        request,
        partial(
            json_answer,
            observation=observation,
            manifest=manifest,
            seed=request.seed,
            bone_lengths=bone_lengths,
        ),
    )
    return Response(content, media_type="application/json")


def _skeleton(body: schemas.ObservedMotion, manifest: Manifest) -> Skeleton | OwnJoints:
    if isinstance(body.skeleton, schemas.SkeletonBody):
        return body.skeleton.own_joints()
    if body.skeleton is None or body.skeleton == manifest.skeleton.name:
        return manifest.skeleton.skeleton()
    return standard_skeleton(body.skeleton)


def _check_limits(body: schemas.ObservedMotion, settings: Settings) -> None:
    if body.num_samples > settings.max_samples:
        raise FieldError(
            pointer="/num_samples",
            found=str(body.num_samples),
            expected=f"this server gives at most {settings.max_samples}",
        )
    if len(body.poses) > settings.max_frames:
        raise PosesError(
            pointer="/poses",
            found=f"{len(body.poses)} frames",
            expected=f"this server takes at most {settings.max_frames}; send the last ones",
        )


def _check_num_poses(
    body: schemas.PredictActionsRequest, settings: Settings, manifest: Manifest, *, frames: int
) -> None:
    """The engine holds futures at the bundle's rate, and the answer at the caller's."""
    longest = max(frames, num_frames(frames, manifest=manifest, fps=body.fps or manifest.fps))
    if body.num_samples * longest > settings.max_poses:
        raise FieldError(
            pointer="/num_samples",
            found=f"{body.num_samples} futures of up to {longest} frames",
            expected=f"this server answers with at most {settings.max_poses} poses; ask for fewer "
            "samples or actions, or for less time or a lower rate",
        )


def _summary(entry: Entry) -> dict[str, object]:
    summary: dict[str, object] = {"name": entry.name, "state": entry.state, "reason": entry.reason}
    manifest = entry.manifest
    if manifest is not None:
        summary |= {
            "version": manifest.version,
            "digest": manifest.digest,
            "description": manifest.description,
            "licence": manifest.licence,
            "attribution": list(manifest.attribution),
            "skeleton": manifest.skeleton.name,
            "joints": list(manifest.skeleton.joints),
            "fps": manifest.fps,
            "num_observed": manifest.num_observed,
            "horizon": manifest.horizon,
            "num_steps": manifest.num_steps,
            "trajectory": manifest.trajectory,
            "actions": list(manifest.actions.labels) if manifest.actions else [],
        }
    return summary
