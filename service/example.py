"""Requests that work: a person who stands, for the OpenAPI document."""

from typing import Any

# body21, metres, +Z up, facing +X.
_STANDING = (
    (0.0, 0.0, 0.96), (0.0, 0.0, 1.06), (-0.01, 0.0, 1.21), (0.0, 0.0, 1.44), (0.03, 0.0, 1.54),
    (0.0, 0.03, 1.38), (0.0, 0.18, 1.38), (0.02, 0.2, 1.1), (0.06, 0.22, 0.86),
    (0.0, -0.03, 1.38), (0.0, -0.18, 1.38), (0.02, -0.2, 1.1), (0.06, -0.22, 0.86),
    (0.0, 0.09, 0.91), (0.02, 0.1, 0.49), (-0.02, 0.1, 0.08), (0.12, 0.11, 0.02),
    (0.0, -0.09, 0.91), (0.02, -0.1, 0.49), (-0.02, -0.1, 0.08), (0.12, -0.11, 0.02),
)  # fmt: skip

EXAMPLE: dict[str, Any] = {
    "poses": [[list(joint) for joint in _STANDING]] * 15,
    "skeleton": "body21",
    "fps": 30,
    "num_samples": 3,
    "seed": 7,
}
ACTIONS_EXAMPLE = EXAMPLE | {"actions": ["walk", "wave-both-hands"]}
