"""Actions as a caller asks for them, in labels and seconds, as the engine takes them."""

from collections.abc import Sequence
from difflib import get_close_matches

from models.bundle import Manifest
from service.errors import FieldError, UnknownActionError

_ROUNDING_S = 5e-4  # messages tell the longest time in milliseconds


def action_indices(labels: Sequence[str], manifest: Manifest) -> tuple[int, ...]:
    """Where labels stand among those of the bundle.

    Raises:
        UnknownActionError: it knows no such action.
    """
    known = manifest.actions.labels if manifest.actions else ()
    for i, label in enumerate(labels):
        if label not in known:
            raise _unknown(label, known, pointer=f"/actions/{i}")
    return tuple(known.index(label) for label in labels)


def max_frames(seconds: float | None, manifest: Manifest) -> int | None:
    """The longest that one action may take in the bundle's frames; None leaves it to the bundle.

    Raises:
        FieldError: it is shorter than a frame, or longer than the bundle's horizon.
    """
    if seconds is None:
        return None
    frame, horizon = 1.0 / manifest.fps, manifest.horizon / manifest.fps
    if not frame - _ROUNDING_S <= seconds <= horizon + _ROUNDING_S:
        raise FieldError(
            pointer="/max_seconds_per_action",
            found=f"{seconds:g} s",
            expected=f"{manifest.name} performs an action for {frame:.3f} s to {horizon:.3f} s",
        )
    return round(seconds * manifest.fps)


def _unknown(label: str, known: Sequence[str], *, pointer: str) -> UnknownActionError:
    asked, lowered = label[:40].lower(), {other.lower(): other for other in known}
    near = [other for other in lowered if asked and asked in other]  # wave, of wave-both-hands
    near += get_close_matches(asked, lowered, n=1, cutoff=0.4)
    nearest = f"; the nearest is {lowered[near[0]]}" if near else ""
    return UnknownActionError(
        pointer=pointer,
        found=repr(label[:40]),
        expected=f"must be one of {', '.join(known)}{nearest}",
    )
