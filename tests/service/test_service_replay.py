import asyncio
from pathlib import Path

import numpy as np
import orjson
import pytest
from live import Live
from tiny_bundles import walking
from typer.testing import CliRunner, Result

from models.motion.formats.bvh import read_bvh, write_bvh
from models.motion.motion import Motion
from models.motion.skeleton import BODY21
from service.asking.exchange import BadRequestError
from service.asking.messages import LivePrediction
from service.asking.replay import recorded, replayed, told
from service.cli import app
from service.client import AsyncClient, Client


@pytest.fixture(autouse=True)
def environment(bundles: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEFUTURES_BUNDLES", str(bundles))


def walk(folder: Path, num_frames: int) -> Path:
    file = folder / "walk.bvh"
    positions = walking(num_frames)
    write_bvh(file, Motion(name="walk", skeleton=BODY21, positions=positions, fps=30.0))
    return file


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["stream", *(str(argument) for argument in arguments)])


def test_a_file_is_replayed_and_each_answer_is_a_line(tmp_path: Path):
    file, out = walk(tmp_path, 45), tmp_path / "answers.ndjson"
    result = run(file, "--speed", "20", "--num-samples", "3", "--seed", "1", "--out", out)
    assert result.exit_code == 0, result.output
    lines, records = result.stdout.splitlines(), out.read_bytes().splitlines()
    assert len(lines) == len(records) > 0
    assert lines[-1].startswith("   1.467 s: 3 futures of 2.00 s by diffusion, 10 of 10 steps, ")
    answers = [orjson.loads(record) for record in records]
    times = [answer["t"] for answer in answers]
    assert times == sorted(set(times))
    assert times[0] >= 14 / 30.0 - 1e-6
    num_joints = read_bvh(file).skeleton.num_joints
    assert np.array(answers[-1]["futures"]).shape == (3, 60, num_joints, 3)


def test_last_answer_is_that_of_a_plain_request(bundles: Path, tmp_path: Path):
    file, out = walk(tmp_path, 20), tmp_path / "answers.ndjson"
    with Live(bundles) as live, Client(live.url) as client:
        result = run(file, "--url", live.url, "--speed", "20", "--seed", "1", "--out", out)
        assert result.exit_code == 0, result.output
        motion = read_bvh(file)
        skeleton = {"joints": motion.skeleton.joints, "parents": motion.skeleton.parents}
        expected = client.predict(motion.positions, skeleton=skeleton, fps=motion.fps, seed=1)
    answer = orjson.loads(out.read_bytes().splitlines()[-1])
    np.testing.assert_allclose(answer["futures"], expected.futures, atol=1e-6)


def test_mistakes_are_one_line(tmp_path: Path):
    def said(*arguments: str | Path) -> str:
        result = run(*arguments)
        assert result.exit_code == 2, result.output
        assert result.stderr.count("\n") == 1
        return result.stderr

    assert "has to see 0.47 s" in said(walk(tmp_path, 10))
    assert "options.model: found 'oracle'" in said(walk(tmp_path, 20), "--model", "oracle")
    assert "no server that answers" in said(walk(tmp_path, 20), "--url", "http://127.0.0.1:1")


def test_a_last_frame_that_no_person_is_like_is_told(bundles: Path):
    positions = walking(30)
    positions[20:, 8] += 50.0
    motion = Motion(name="walk", skeleton=BODY21, positions=positions, fps=30.0)

    async def answers(url: str) -> list[LivePrediction | BadRequestError]:
        async with AsyncClient(url) as client, client.live(rate_hz=60.0, num_samples=1) as live:
            return [answer async for answer in replayed(motion, live, speed=1.0)]

    with Live(bundles) as live:
        found = asyncio.run(answers(live.url))
    refused = found[-1]
    assert isinstance(refused, BadRequestError)
    assert told(refused).endswith(f" s: {refused}")
    record = orjson.loads(recorded(refused))
    assert record["t"] == record["problem"]["t"] == pytest.approx(29 / 30.0)
    assert record["problem"]["status"] == 422
