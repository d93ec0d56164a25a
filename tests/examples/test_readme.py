"""The Python of the README does what the README says, with the bundles that ship."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import pytest
from live import Live

import models
from service.client import Client

ROOT = Path(__file__).parents[2]
BLOCKS = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)


@pytest.fixture(scope="module")
def live() -> Iterator[Live]:
    with Live(Path(models.__path__[0]) / "bundles") as running:
        yield running


def ran(block: str, live: Live) -> dict[str, Any]:
    """Its names after a block has run on our server, with deadlines that any machine keeps."""
    poses = np.array(orjson.loads((ROOT / "docs/observation.json").read_bytes())["poses"])
    code = block.replace("http://localhost:8000", live.url)
    code = re.sub(r"deadline_ms=\d+", "deadline_ms=60_000", code)
    with Client(live.url) as client:
        names: dict[str, Any] = {"poses": poses, "client": client}
        exec(compile(code, "README.md", "exec"), names)  # noqa: S102 - it is our own
    return names


def test_the_first_example_gives_what_it_says(live: Live):
    told = re.search(r"prediction\.futures  # \((\d+), (\d+), (\d+), 3\) metres", BLOCKS[0])
    assert told is not None
    prediction = ran(BLOCKS[0], live)["prediction"]
    assert prediction.futures.shape == (*map(int, told.groups()), 3)


@pytest.mark.parametrize("index", range(1, len(BLOCKS)))
def test_the_other_examples_run(live: Live, index: int):
    ran(BLOCKS[index], live)
