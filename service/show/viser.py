"""Futures in viser, a viewer in the browser: `pip install 'posefutures[viser]'`."""

from collections.abc import Sequence

import numpy as np
import viser
from jaxtyping import Float

from service.asking.messages import ActionsPrediction, Prediction
from service.show.bones import OBSERVED_RGB, bones, future_rgb, parents_of

THICKNESS_M = 0.012


def show(
    answer: Prediction | ActionsPrediction,
    *,
    observed: Float[np.ndarray, "T J 3"] | None = None,
    parents: Sequence[int] | None = None,
    server: viser.ViserServer | None = None,
) -> viser.ViserServer:
    """A server whose page shows the futures, with a slider for the time; and the pose now, if told.

    Positions are drawn as they are: metres, +Z up, unless the scene of the ``server`` says else.
    A future of actions stays in its last frame. The server is made on port 8080 where none is
    given, and stays until its ``stop``.

    Raises:
        ValueError: the answer has no futures, or its skeleton is no standard one and no ``parents``
            are given.
    """
    if not len(answer.futures):
        raise ValueError("answer: found no futures; ask for return: futures.")
    tree = parents_of(answer.joints, parents)
    lines = [bones(np.asarray(future, dtype=np.float32), tree) for future in answer.futures]
    server = server or viser.ViserServer()
    if observed is not None:
        server.scene.add_line_segments(
            "/observed",
            bones(np.asarray(observed[-1], dtype=np.float32), tree),
            OBSERVED_RGB,
            thickness=THICKNESS_M,
        )
    drawn = [
        server.scene.add_line_segments(
            f"/futures/{i}", frames[0], future_rgb(i), thickness=THICKNESS_M
        )
        for i, frames in enumerate(lines)
    ]
    last = max(len(frames) for frames in lines) - 1
    slider = server.gui.add_slider("frame", min=0, max=max(last, 1), step=1, initial_value=0)

    @slider.on_update
    def _(_: object) -> None:
        for handle, frames in zip(drawn, lines, strict=True):
            handle.points = frames[min(slider.value, len(frames) - 1)]

    return server
