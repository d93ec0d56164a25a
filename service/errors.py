"""Everything that can go wrong in the service, as one tree; HTTP shows it as problem+json.

ServiceError                       status  problem
├── InputError                             the caller's fault
│   ├── MalformedBodyError         400     malformed-body
│   ├── UnauthorisedError          401     unauthorised: no key, or an unknown one
│   ├── NotFoundError              404     not-found
│   ├── UnknownRequestError        404     unknown-request: nothing of this id is under way
│   ├── MethodError                405     method-not-allowed
│   ├── NotAcceptableError         406     not-acceptable
│   ├── CancelledRequestError      409     cancelled: by DELETE, or its id is under way already
│   ├── BodyTooLargeError          413     body-too-large
│   ├── MediaTypeError             415     unsupported-media-type
│   ├── FieldError                 422     invalid-field
│   │   ├── PosesError             422     invalid-poses
│   │   ├── TooFewFramesError      422     too-few-frames
│   │   ├── UnknownSkeletonError   422     unknown-skeleton
│   │   ├── UnknownModelError      422     unknown-model (404 in a path)
│   │   ├── UnsuitableModelError   422     unsuitable-model: it performs actions, or performs none
│   │   ├── UnknownActionError     422     unknown-action
│   │   └── MotionFileError        422     unreadable-file: it is damaged, or of a kind not read
│   └── RateLimitedError           429     rate-limited: this caller asks too often
├── OverloadedError                429     overloaded: the queue is full
├── UnavailableError               503     unavailable: loading, stopping or refused bundle
├── DeadlineError                  504     deadline-too-short: not even one step fits
└── EngineError                    500     prediction-failed
    ├── GraphError                 500     a graph could not run
    └── NonFiniteError             500     a graph gave NaN or infinity
"""

from typing import ClassVar


class ServiceError(Exception):
    """Something that a caller is told: where, what was found, what would be right."""

    status: ClassVar[int] = 500
    slug: ClassVar[str] = "internal"
    title: ClassVar[str] = "The server failed"
    retry_after_s: float | None = None
    """Seconds after which the same request may be answered; None where waiting does not help."""

    def __init__(
        self, detail: str, *, pointer: str | None = None, found: str = "", expected: str = ""
    ) -> None:
        super().__init__(detail)
        self.detail = detail
        self.pointer = pointer
        self.found = found
        self.expected = expected


class InputError(ServiceError):
    """The request cannot be answered as it was sent."""

    status = 400
    slug = "bad-request"
    title = "The request is not valid"


class MalformedBodyError(InputError):
    """The body is not a JSON object."""

    slug = "malformed-body"
    title = "The body is not a JSON object"


class UnauthorisedError(InputError):
    """The request has no API key, or one that the server does not know."""

    status = 401
    slug = "unauthorised"
    title = "An API key is needed"


class NotFoundError(InputError):
    """Nothing lives at this path."""

    status = 404
    slug = "not-found"
    title = "There is nothing at this path"


class UnknownRequestError(InputError):
    """No request of this id is under way."""

    status = 404
    slug = "unknown-request"
    title = "No such request is under way"


class MethodError(InputError):
    """The path does not take this method."""

    status = 405
    slug = "method-not-allowed"
    title = "The path does not take this method"


class NotAcceptableError(InputError):
    """The caller accepts no media type that this path answers in."""

    status = 406
    slug = "not-acceptable"
    title = "The answer has none of the accepted media types"


class CancelledRequestError(InputError):
    """The request was cancelled by its id."""

    status = 409
    slug = "cancelled"
    title = "The request was cancelled"


class BodyTooLargeError(InputError):
    """The body has more bytes than the server takes."""

    status = 413
    slug = "body-too-large"
    title = "The body is too large"


class MediaTypeError(InputError):
    """The body is declared as a media type that is not read."""

    status = 415
    slug = "unsupported-media-type"
    title = "The body's media type is not supported"


class FieldError(InputError):
    """A field is missing, unknown, of the wrong type or out of range."""

    status = 422
    slug = "invalid-field"
    title = "A field is not valid"

    def __init__(self, *, pointer: str, found: str, expected: str) -> None:
        super().__init__(
            f"{_where(pointer)}: found {found}; {expected}.",
            pointer=pointer,
            found=found,
            expected=expected,
        )


class PosesError(FieldError):
    """The poses have a wrong shape or a coordinate that no body has."""

    slug = "invalid-poses"
    title = "The poses are not valid"


class TooFewFramesError(FieldError):
    """The observation is shorter than the model needs."""

    slug = "too-few-frames"
    title = "The observation is too short"


class UnknownSkeletonError(FieldError):
    """No standard skeleton has this name, or own names do not say enough about the body."""

    slug = "unknown-skeleton"
    title = "The skeleton is not known"


class UnknownModelError(FieldError):
    """No bundle has this name."""

    slug = "unknown-model"
    title = "The model is not known"


class UnsuitableModelError(FieldError):
    """The bundle performs actions where none are asked for, or performs none where they are."""

    slug = "unsuitable-model"
    title = "The model does not answer such requests"


class UnknownActionError(FieldError):
    """The bundle knows no action of this label."""

    slug = "unknown-action"
    title = "The action is not known"


class MotionFileError(FieldError):
    """The body is no motion file that can be read."""

    slug = "unreadable-file"
    title = "The file cannot be read"


class RateLimitedError(InputError):
    """This caller has sent more requests than it may."""

    status = 429
    slug = "rate-limited"
    title = "Too many requests of one caller"

    def __init__(self, detail: str, *, retry_after_s: float) -> None:
        super().__init__(detail)
        self.retry_after_s = retry_after_s


class OverloadedError(ServiceError):
    """The server has as much to do as it takes on."""

    status = 429
    slug = "overloaded"
    title = "The server is busy"

    def __init__(self, detail: str, *, retry_after_s: float) -> None:
        super().__init__(detail)
        self.retry_after_s = retry_after_s


class UnavailableError(ServiceError):
    """The model cannot answer now: still loading, stopping, or its bundle was refused."""

    status = 503
    slug = "unavailable"
    title = "The model cannot answer now"
    retry_after_s = 1.0


class DeadlineError(ServiceError):
    """Not even one step fits between now and the deadline."""

    status = 504
    slug = "deadline-too-short"
    title = "The deadline is too short"


class EngineError(ServiceError):
    """The engine could not compute this request."""

    slug = "prediction-failed"
    title = "The prediction failed"


class GraphError(EngineError):
    """A graph of the bundle could not run."""


class NonFiniteError(EngineError):
    """A graph of the bundle gave NaN or infinity."""


def _where(pointer: str) -> str:
    """A JSON pointer as programmers write it: /poses/3/11 is poses[3][11]."""
    parts = pointer.split("/")[1:]
    where = "".join(f"[{part}]" if part.isdigit() else f".{part}" for part in parts)
    return where.lstrip(".") or "the body"
