"""What recipes learn from: our public motion capture, and the windows of the field's benchmarks."""

from collections.abc import Mapping
from dataclasses import replace

from models.motion.skeleton import BODY21, H36M17, SMPL22
from models.system import Augmentation, Data

EVERYTHING = {"bandai": 0.5, "cmu": 0.45, "hdm05": 0.05}
_CMU_HELD_OUT = (
    "subject=135",
    "subject=13",
    "action=washwindow",
    "action=drink",
    "action=directing_traffic",
    "action=soccer",
)
HELD_OUT = ("style=tired", "style=elderly", *_CMU_HELD_OUT)
"""Two styles, two subjects and four actions, which what is measured on them must not learn."""
ONE_STYLE = ("style=masculine", *_CMU_HELD_OUT)
"""The same with one style of many clips in the place of two that are near to each other."""

TWO_SECONDS = Data(skeleton=BODY21, fps=30.0, num_observed=15, horizon=60)
"""Half a second to two seconds at 30 fps."""
H36M = Data(skeleton=H36M17, fps=50.0, num_observed=25, horizon=100)
"""The protocol of Human3.6M: half a second to two seconds at 50 fps."""
AMASS = Data(skeleton=SMPL22, fps=60.0, num_observed=30, horizon=120)
"""The protocol of AMASS (Barquero et al. 2023): half a second to two seconds at 60 fps."""


def mocap_data(
    *, shares: Mapping[str, float] | None = None, hold_out: tuple[str, ...] = ()
) -> Data:
    """`TWO_SECONDS` of our motion capture, varied, for networks that see a canonical frame.

    Args:
        shares: of the windows by source; those of `EVERYTHING` by default.
        hold_out: selectors of clips that must not be learnt from.
    """
    return replace(
        TWO_SECONDS,
        shares=shares or EVERYTHING,
        hold_out=hold_out,
        augmentation=Augmentation(
            yaw=False,  # the canonical frame undoes it
            slowest=0.8,
            fastest=1.25,
            body_scale=0.05,
            bone_scale=0.06,
            observation_noise=0.008,
        ),
    )
