"""Whether a request fits a bundle."""

from models.bundle import Manifest
from service.engine.trajectory import Request
from service.errors import FieldError


def check(request: Request, manifest: Manifest) -> None:
    """Refuse a request that the bundle cannot answer.

    Raises:
        FieldError: the observation does not fit the bundle, or a number is out of range.
    """
    shape = (manifest.num_observed, len(manifest.skeleton.joints), 3)
    if request.observation.shape != shape:
        raise FieldError(
            pointer="/observation",
            found=f"shape {request.observation.shape}",
            expected=f"{manifest.name} takes (frames, joints, xyz) = {shape}",
        )
    if request.num_samples < 1:
        raise FieldError(
            pointer="/num_samples", found=str(request.num_samples), expected="must be 1 or more"
        )
    if request.num_steps is not None and not 1 <= request.num_steps <= manifest.num_steps:
        raise FieldError(
            pointer="/num_steps",
            found=str(request.num_steps),
            expected=f"{manifest.name} runs 1 to {manifest.num_steps} steps",
        )
    _check_length(request, manifest)
    _check_actions(request, manifest)
    _check_stop(request, manifest)


def _check_length(request: Request, manifest: Manifest) -> None:
    horizon, tolerance_m = request.horizon, request.tolerance_m
    if horizon is not None and (manifest.actions or horizon < 1):
        longest = "performs actions, which have lengths of their own"
        raise FieldError(
            pointer="/horizon_s",
            found=f"{horizon / manifest.fps:g} s",
            expected=f"{manifest.name} {longest if manifest.actions else 'makes a frame or more'}",
        )
    if tolerance_m is not None and (manifest.actions or not tolerance_m > 0):
        settles = "performs actions in one step each"
        raise FieldError(
            pointer="/tolerance_m",
            found=f"{tolerance_m:g} m",
            expected=f"{manifest.name} {settles if manifest.actions else 'takes more than 0'}",
        )


def _check_actions(request: Request, manifest: Manifest) -> None:
    labels = manifest.actions.labels if manifest.actions else ()
    unknown = [index for index in request.actions if not 0 <= index < len(labels)]
    if not unknown and bool(request.actions) == bool(labels):
        return
    performs = f"one action or more of {', '.join(labels)}" if labels else "no actions"
    raise FieldError(
        pointer="/actions",
        found=f"action {unknown[0]}" if unknown else "none",
        expected=f"{manifest.name} performs {performs}",
    )


def _check_stop(request: Request, manifest: Manifest) -> None:
    frames, threshold_m = request.max_frames, request.stop_threshold_m
    if frames is not None and not (manifest.actions and 1 <= frames <= manifest.horizon):
        longest = f"performs an action for at most {manifest.horizon / manifest.fps:g} s"
        raise FieldError(
            pointer="/max_seconds_per_action",
            found=f"{frames / manifest.fps:g} s",
            expected=f"{manifest.name} {longest if manifest.actions else 'performs no actions'}",
        )
    if threshold_m is not None and not (manifest.actions and threshold_m > 0):
        least = "takes a threshold above 0"
        raise FieldError(
            pointer="/stop_threshold",
            found=f"{threshold_m:g} m",
            expected=f"{manifest.name} {least if manifest.actions else 'performs no actions'}",
        )
