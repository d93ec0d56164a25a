"""The dry run of a request: how its poses are understood, and what is odd about them."""

from asyncio import to_thread

import numpy as np
from fastapi import APIRouter

from models.bundle import Manifest
from models.motion.axes import Axes
from models.motion.skeleton import BODY21, Skeleton, joint_map
from service import schemas
from service.errors import (
    BodyTooLargeError,
    FieldError,
    MalformedBodyError,
    MediaTypeError,
    OverloadedError,
    RateLimitedError,
    ServiceError,
    UnauthorisedError,
    UnavailableError,
)
from service.http.body import BodyRoute
from service.http.checks import findings, whole_body
from service.http.dependencies import TheCatalog
from service.http.problems import content_of, declared
from service.observation import Seen, body_weights, caller_rate, observe, read_seen, sources
from service.poses.skeletons import requested_skeleton
from service.poses.stance import guessed_axes

router = APIRouter(route_class=BodyRoute, responses=declared(UnauthorisedError))


@router.post(
    "/skeletons/validate",
    responses=declared(
        MalformedBodyError,
        BodyTooLargeError,
        MediaTypeError,
        FieldError,
        RateLimitedError,
        OverloadedError,
        UnavailableError,
    ),
)
async def validate(body: schemas.ObservedPoses, catalog: TheCatalog) -> schemas.Validation:
    """How poses are understood, and what is odd about them; nothing is predicted.

    An unknown skeleton or numbers that are none are errors here as everywhere.
    """
    entry = catalog.chosen(body.model, with_actions=False)
    if entry.manifest is None:
        raise UnavailableError(f"model: the bundle {entry.name} was refused: {entry.reason}")
    return await to_thread(_validation, body, entry.manifest)


def _validation(body: schemas.ObservedPoses, manifest: Manifest) -> schemas.Validation:
    axes = body.axes.axes()
    seen = read_seen(
        body.poses,
        skeleton=requested_skeleton(body.caller_skeleton(), manifest),
        axes=axes,
        times=body.timestamps,
        confidence=body.confidence,
    )
    _check_body(seen)
    fps = caller_rate(seen, body.fps, manifest)
    try:
        warnings = observe(seen, axes=axes, fps=fps, manifest=manifest).warnings
        problem = None
    except ServiceError as error:
        warnings = ()
        problem = schemas.Problem.model_validate(content_of(error, status=error.status))
    return _told(seen, axes, fps).model_copy(
        update={"predicts": problem is None, "problem": problem, "warnings": list(warnings)}
    )


def _check_body(seen: Seen) -> None:
    if not np.isfinite(seen.world).any() or len(seen.world) < 2:
        raise FieldError(
            pointer="/poses",
            found=f"{len(seen.world)} frames",
            expected="there must be two or more, with joints in them",
        )
    body_weights(seen.skeleton, np.isfinite(seen.world[:, :, 0]).any(axis=0), BODY21)


def _told(seen: Seen, axes: Axes, fps: float) -> schemas.Validation:
    place = {index: i for i, index in enumerate(seen.order)}
    given = sources(seen)
    body = whole_body(seen)
    looks = guessed_axes(body, axes)
    mapped, estimated, guessed = _resolved(seen.skeleton)
    return schemas.Validation(
        predicts=True,
        skeleton=seen.skeleton.name,
        joints=[seen.skeleton.joints[place[i]] for i in range(len(place))],
        joint_sources=[given[place[i]] for i in range(len(place))],
        map=mapped,
        estimated=estimated,
        guessed=guessed,
        axes=schemas.AxesBody(up=axes.up, units=axes.units, handed=axes.handed),
        looks_like=schemas.AxesBody(up=looks.up, units=looks.units, handed=looks.handed),
        fps=fps,
        findings=[
            schemas.ValidationFinding(about=found.about, sentence=found.sentence)
            for found in findings(seen, body, axes=axes, looks=looks, fps=fps)
        ],
        warnings=[],
    )


def _resolved(skeleton: Skeleton) -> tuple[dict[str, str], dict[str, list[str]], list[str]]:
    """Joints that are one of body21's, joints of body21 that several tell of, and the others."""
    mapped: dict[str, str] = {}
    estimated: dict[str, list[str]] = {}
    guessed: list[str] = []
    for joint, row, known in zip(BODY21.joints, *joint_map(skeleton, BODY21), strict=True):
        names = [skeleton.joints[int(i)] for i in np.flatnonzero(row)]
        if not known:
            guessed.append(joint)
        elif len(names) == 1:
            mapped[names[0]] = joint
        else:
            estimated[joint] = names
    return mapped, estimated, guessed
