"""Makes the page's demo motions: a person who stands, then performs what a server is asked for.

    python web/make_demos.py http://localhost:8000

Nothing of a recording goes into them: the start is made up (the example of the OpenAPI document),
the rest is a future of the server's default model for actions.
"""

import sys
from pathlib import Path

import numpy as np
import orjson

from service.client import Client
from service.example import EXAMPLE

FOLDER = Path(__file__).parents[1] / "service/viewer/demos"
DEMOS = {  # file: (seed, actions)
    "stroll-and-wave": (3, ("walk", "wave-both-hands", "walk")),
    "round-the-corner": (5, ("walk-turn-left", "walk", "walk-turn-right")),
    "sprint": (1, ("run", "raise-up-both-hands")),
    "hello": (2, ("raise-up-right-hand", "wave-left-hand", "walk")),
}


def main(url: str) -> None:
    """Write all of them; the first frames, in which nobody moves, are left out."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    standing = np.array(EXAMPLE["poses"])
    with Client(url) as client:
        for name, (seed, actions) in DEMOS.items():
            answer = client.predict_actions(
                standing, actions, fps=30, num_samples=1, seed=seed, max_seconds_per_action=3
            )
            poses = np.concatenate([standing[10:], answer.futures[0]]).round(3)
            motion = {"name": name, "skeleton": "body21", "fps": 30, "poses": poses.tolist()}
            (FOLDER / f"{name}.json").write_bytes(orjson.dumps(motion))
            print(name, len(poses), [(s.action, s.end) for s in answer.segments[0]])


main(sys.argv[1])
