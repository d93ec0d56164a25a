import socket
from pathlib import Path
from threading import Thread

import numpy as np
import orjson
import pytest
import typer
import uvicorn
from tiny_bundles import walking
from typer.testing import CliRunner, Result

from models.motion.formats.bvh import read_bvh, write_bvh
from models.motion.formats.files import read_motion
from models.motion.gaps import without_gaps
from models.motion.kinematics import (
    bone_lengths,
    forward_kinematics,
    inverse_kinematics,
    rest_pose,
)
from models.motion.motion import Motion
from models.motion.skeleton import BODY21, SENT_ORDERS, SKELETONS, joint_map
from models.motion.standards import STANDARDS
from service.app import create_app
from service.cli import app
from service.settings import Settings


@pytest.fixture(autouse=True)
def environment(bundles: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEFUTURES_BUNDLES", str(bundles))


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    file = tmp_path / "walk.bvh"
    poses, parents = walking(40), BODY21.parents
    rest = rest_pose(poses, BODY21)  # nothing but rotations, as in most files
    rotations = inverse_kinematics(poses, rest, parents)
    rigid = forward_kinematics(rotations, rest, parents, poses[:, 0])
    write_bvh(file, Motion(name="walk", skeleton=BODY21, positions=rigid, fps=30.0))
    return file


@pytest.fixture
def performers(bundles_with_actions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("POSEFUTURES_BUNDLES", str(bundles_with_actions))


with_actions = pytest.mark.usefixtures("performers")


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def body(path: Path) -> np.ndarray:
    """(T, 21, 3) metres: the joints of body21 in a file that may have others too."""
    motion = read_bvh(path)
    return motion.positions[:, [motion.skeleton.index(joint) for joint in BODY21.joints]]


def one_line(result: Result) -> str:
    assert result.exit_code == 2, result.output
    assert result.stderr.count("\n") == 1
    assert result.stderr.startswith("posefutures: ")
    return result.stderr


def test_predict_writes_bvh_in_the_skeleton_and_rate_of_the_file(walk: Path, tmp_path: Path):
    result = run("predict", walk, "--num-samples", "3", "--seed", "1", "--out", tmp_path / "out")
    assert result.exit_code == 0, result.output
    written = sorted((tmp_path / "out").glob("*.bvh"))
    assert [path.name for path in written] == [f"walk-future-{i}.bvh" for i in range(3)]
    assert read_bvh(written[0]).fps == pytest.approx(30.0)
    observed, future = body(walk), body(written[0])
    assert len(future) == 60
    assert np.abs(future[0] - observed[-1]).max() < 0.1
    lengths = bone_lengths(future, BODY21.parents)
    expected = bone_lengths(observed[-1], BODY21.parents)
    np.testing.assert_allclose(lengths, np.broadcast_to(expected, lengths.shape), atol=1e-3)


def test_predict_writes_npz_from_any_second(walk: Path, tmp_path: Path):
    result = run("predict", walk, "--format", "npz", "--at", "1.0", "--out", tmp_path,
                 "--model", "still", "--num-samples", "2")  # fmt: skip
    assert result.exit_code == 0, result.output
    with np.load(tmp_path / "walk-futures.npz") as archive:
        assert archive["futures"].shape == (2, 60, 21, 3)
        np.testing.assert_allclose(
            archive["futures"][0, 0], read_bvh(walk).positions[30], atol=1e-3
        )
        assert tuple(archive["joints"]) == BODY21.joints


@with_actions
def test_actions_are_written_each_as_long_as_it_took(walk: Path, tmp_path: Path):
    options = ("--actions", "reach, wave", "--seed", "5", "--num-samples", "4", "--out", tmp_path)
    for output_format in ("bvh", "npz"):
        result = run("predict", walk, *options, "--format", output_format)
        assert result.exit_code == 0, result.output
        assert "by actions, seed 5" in result.stdout
    with np.load(tmp_path / "walk-futures.npz") as archive:
        lengths, futures = archive["lengths"], archive["futures"]
        assert archive["actions"].tolist() == ["reach", "wave"]
        assert archive["segment_ends"].shape == archive["stopped"].shape == (4, 2)
        np.testing.assert_array_equal(archive["segment_ends"][:, -1], lengths)
        assert archive["stopped"].all()
    assert futures.shape == (4, lengths.max(), 21, 3)
    assert len(set(lengths)) > 1
    for i, length in enumerate(lengths):
        written = body(tmp_path / f"walk-future-{i}.bvh")
        np.testing.assert_allclose(written, futures[i, :length], atol=1e-3)
        assert np.all(futures[i, length:] == futures[i, length - 1])


@with_actions
def test_actions_are_cut_off_where_it_is_asked(walk: Path, tmp_path: Path):
    for option in (("--max-seconds-per-action", "0.2"), ("--stop-threshold", "1")):
        run("predict", walk, "--actions", "wave", "--format", "npz", "--out", tmp_path, *option)
        with np.load(tmp_path / "walk-futures.npz") as archive:
            assert set(archive["lengths"]) == {6}


@with_actions
def test_mistakes_about_actions_are_one_line(walk: Path):
    def said(*options: str) -> str:
        return one_line(run("predict", walk, *options))

    assert "actions[1]: found 'weve'; must be one of reach, crouch, wave; the nearest is wave." in (
        said("--actions", "reach,weve")
    )
    assert "actions[0]: found ''" in said("--actions", "")
    assert "model: found 'still'; must be one that performs actions" in (
        said("--actions", "wave", "--model", "still")
    )
    assert "predicts without actions: diffusion, still" in said("--model", "actions")
    assert "max_seconds_per_action: found 9 s" in (
        said("--actions", "wave", "--max-seconds-per-action", "9")
    )
    assert "stop_threshold: found 0" in said("--actions", "wave", "--stop-threshold", "0")
    for option in ("--stop-threshold", "--max-seconds-per-action"):
        assert "found 0.1; it is for a request with --actions" in said(option, "0.1")
    assert "num_steps: found 3; it is for a request without --actions" in (
        said("--actions", "wave", "--num-steps", "3")
    )


def test_actions_without_a_bundle_that_performs_them_are_one_line(walk: Path):
    assert "no bundle that performs actions" in one_line(run("predict", walk, "--actions", "wave"))
    assert run("actions").stdout == ""


@with_actions
def test_actions_and_both_defaults_are_listed():
    assert run("actions").stdout.splitlines() == [
        "actions", "  reach", "  crouch", "  wave  raises a hand",
    ]  # fmt: skip
    assert [line.split("  1.0.0")[0] for line in run("models").stdout.splitlines()] == [
        "* actions", "* diffusion", "  still",
    ]  # fmt: skip


def test_same_seed_writes_the_same_files(walk: Path, tmp_path: Path):
    for out in ("a", "b"):
        run("predict", walk, "--seed", "9", "--num-samples", "1", "--out", tmp_path / out)
    names = ("a/walk-future-0.bvh", "b/walk-future-0.bvh")
    first, second = ((tmp_path / name).read_bytes() for name in names)
    assert first == second


def test_modes_and_a_longer_future_are_written_and_told(walk: Path, tmp_path: Path):
    result = run("predict", walk, "--format", "npz", "--out", tmp_path, "--num-samples", "12",
                 "--num-modes", "3", "--horizon-s", "3", "--num-steps", "4")  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "stopped by num_steps" in result.stdout
    assert result.stdout.count("% like future") == 3
    with np.load(tmp_path / "walk-futures.npz") as archive:
        assert archive["futures"].shape == (12, 90, 21, 3)
        assert archive["probabilities"].sum() == pytest.approx(1.0)
        assert set(archive["modes"]) <= set(range(12))


def test_stream_tells_of_each_step_and_writes_the_same(walk: Path, tmp_path: Path):
    options = ("--seed", "9", "--num-samples", "1", "--num-steps", "3")
    plain = run("predict", walk, *options, "--out", tmp_path / "plain")
    streamed = run("predict", walk, *options, "--out", tmp_path / "streamed", "--stream")
    assert plain.exit_code == streamed.exit_code == 0, streamed.output
    steps = [line for line in streamed.stderr.splitlines() if line.startswith("step ")]
    assert steps
    assert all(" of 10: " in line and line.endswith(" m moved") for line in steps)
    first, second = (tmp_path / f"{out}/walk-future-0.bvh" for out in ("plain", "streamed"))
    np.testing.assert_allclose(read_bvh(first).positions, read_bvh(second).positions, atol=1e-3)


@with_actions
def test_stream_tells_of_each_chunk_of_actions_and_writes_the_same(walk: Path, tmp_path: Path):
    options = ("--actions", "reach,wave", "--seed", "9", "--num-samples", "1")
    plain = run("predict", walk, *options, "--out", tmp_path / "plain")
    streamed = run("predict", walk, *options, "--out", tmp_path / "streamed", "--stream")
    assert plain.exit_code == streamed.exit_code == 0, streamed.output
    steps = [line for line in streamed.stderr.splitlines() if line.startswith("step ")]
    assert steps
    assert all(" of 16 at most: " in line and line.endswith(" frames") for line in steps)
    first, second = (tmp_path / f"{out}/walk-future-0.bvh" for out in ("plain", "streamed"))
    np.testing.assert_allclose(read_bvh(first).positions, read_bvh(second).positions, atol=1e-3)


def test_a_running_server_is_asked(
    bundles: Path, walk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    application = create_app(Settings(bundles=bundles, api_keys="k1,k2"))
    monkeypatch.setenv("POSEFUTURES_BUNDLES", str(tmp_path / "nowhere"))
    server = uvicorn.Server(uvicorn.Config(application, log_config=None))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        thread = Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            refused = run("predict", walk, "--url", url, "--out", tmp_path)
            monkeypatch.setenv("POSEFUTURES_API_KEYS", "k2")
            options = ("--num-samples", "2", "--deadline-ms", "60000", "--tolerance-m", "1e-6")
            result = run("predict", walk, "--url", url, "--out", tmp_path, *options)
        finally:
            server.should_exit = True
            thread.join()
    assert "authorization: found no key" in one_line(refused)
    assert result.exit_code == 0, result.output
    assert len(list(tmp_path.glob("walk-future-*.bvh"))) == 2


def test_file_cut_in_the_middle_is_one_line(walk: Path):
    text = walk.read_text()
    walk.write_text(text[: len(text) * 2 // 3])
    assert "walk.bvh" in one_line(run("predict", walk))


def test_other_mistakes_are_one_line(walk: Path, tmp_path: Path):
    assert "nowhere.bvh" in one_line(run("predict", tmp_path / "nowhere.bvh"))
    assert "must be one of diffusion, still" in one_line(run("predict", walk, "--model", "oracle"))
    assert "at: found 9 s" in one_line(run("predict", walk, "--at", "9"))
    assert "num_steps: found 99" in one_line(run("predict", walk, "--num-steps", "99"))
    assert "found no server that answers" in (
        one_line(run("predict", walk, "--url", "http://127.0.0.1:1"))
    )


def test_bad_setting_is_one_line(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("POSEFUTURES_THREADS", "many")
    assert "POSEFUTURES_THREADS: found 'many'" in one_line(run("models"))


def test_models_are_listed_with_the_default_marked():
    lines = run("models").stdout.splitlines()
    assert lines[0].startswith("* diffusion")
    assert lines[1].startswith("  still")


@pytest.mark.parametrize("suffix", ["bvh", "json", "npz"])
def test_convert_keeps_the_motion(walk: Path, tmp_path: Path, suffix: str):
    out = tmp_path / f"out.{suffix}"
    result = run("convert", walk, out)
    assert result.exit_code == 0, result.output
    assert "40 frames of 21 joints at 30 frames a second" in result.output
    before, after = read_motion(walk), read_motion(out)
    order = [after.skeleton.index(joint) for joint in before.skeleton.joints]
    np.testing.assert_allclose(after.positions[:, order], before.positions, atol=1e-4)
    assert after.fps == pytest.approx(before.fps)


def test_convert_puts_a_motion_on_another_skeleton_at_another_rate(walk: Path, tmp_path: Path):
    out = tmp_path / "out.npz"
    assert run("convert", walk, out, "--skeleton", "mixamo", "--fps", "60").exit_code == 0
    motion = read_motion(out)
    assert (motion.skeleton.joints[0], motion.fps) == ("mixamorig:Hips", 60.0)
    np.testing.assert_allclose(motion.positions[::2, 0], read_motion(walk).positions[:, 0],
                               atol=1e-4)  # fmt: skip


@pytest.fixture
def webcam(tmp_path: Path) -> Path:
    """Frames as MediaPipe writes them, whose bones tremble, and of which a wrist is hidden once."""
    weights, _ = joint_map(BODY21, SKELETONS["mediapipe33"])
    order = list(SENT_ORDERS["mediapipe33"])
    world = np.empty((40, 33, 3))
    world[:, order] = np.einsum("ij,tjk->tik", weights, walking(40))
    world += np.random.default_rng(1).normal(0.0, 0.02, world.shape)
    raw = STANDARDS["mediapipe33"].axes.from_metres(world)
    keys = ("x", "y", "z", "visibility")
    seen = np.concatenate([raw, np.ones((40, 33, 1))], axis=-1)
    seen[7, order[SKELETONS["mediapipe33"].index("left_wrist")], 3] = 0.0
    frames = [
        {"worldLandmarks": [[dict(zip(keys, joint, strict=True)) for joint in pose]]}
        for pose in seen.tolist()
    ]
    file = tmp_path / "webcam.json"
    file.write_bytes(orjson.dumps(frames))
    return file


@pytest.mark.parametrize("suffix", ["bvh", "glb"])
def test_convert_fixes_bones_where_it_is_asked(webcam: Path, tmp_path: Path, suffix: str):
    plain, fixed = (tmp_path / f"{name}.{suffix}" for name in ("plain", "fixed"))
    assert run("convert", webcam, plain).exit_code == 0
    assert run("convert", webcam, fixed, "--fix-bones").exit_code == 0
    if suffix == "glb":  # a format that we do not read: its joints' paths are animated no more
        assert fixed.stat().st_size < plain.stat().st_size
        return
    as_is, motion = read_motion(plain), read_motion(fixed)
    seen = without_gaps(read_motion(webcam))
    order = [as_is.skeleton.index(joint) for joint in seen.skeleton.joints]
    np.testing.assert_allclose(as_is.positions[:, order], seen.positions, atol=1e-3)
    bones = [("elbow", "shoulder"), ("wrist", "elbow"), ("knee", "hip"), ("ankle", "knee")]
    for lower, upper in bones:
        steady, trembling = (
            one.positions[:, one.skeleton.index(f"left_{lower}")]
            - one.positions[:, one.skeleton.index(f"left_{upper}")]
            for one in (motion, as_is)
        )
        lengths, before = (np.linalg.norm(path, axis=-1) for path in (steady, trembling))
        assert np.ptp(lengths) < 4e-4
        assert np.ptp(before) > 0.02
        assert np.median(before) == pytest.approx(np.median(lengths), abs=1e-3)
        np.testing.assert_allclose(
            steady / lengths[:, None], trembling / before[:, None], atol=2e-3
        )


def test_convert_says_what_is_wrong_in_one_line(walk: Path, tmp_path: Path):
    assert "'.fbx'; it must be one of .bvh, .glb" in one_line(run("convert", walk, "x.fbx"))
    assert "'octopus'" in one_line(run("convert", walk, "x.bvh", "--skeleton", "octopus"))
    assert "No such file" in one_line(run("convert", tmp_path / "no.bvh", "x.bvh"))


@pytest.mark.parametrize("suffix", ["glb", "json"])
def test_predict_writes_other_files_too(walk: Path, tmp_path: Path, suffix: str):
    options = ("--num-samples", "2", "--seed", "1", "--format", suffix, "--out", tmp_path / "out")
    assert run("predict", walk, *options).exit_code == 0
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == [f"walk-future-{i}.{suffix}" for i in range(2)]


def test_flags_are_frozen():
    commands = typer.main.get_command(app).commands  # type: ignore[attr-defined]
    flags = {name: [p.name for p in command.params] for name, command in commands.items()}
    assert flags == {
        "serve": ["host", "port"],
        "models": [],
        "actions": [],
        "predict": [
            "file", "num_samples", "num_steps", "deadline_ms", "tolerance_m", "horizon_s",
            "num_modes", "model", "seed", "out", "output_format", "at",
            "actions", "stop_threshold", "max_seconds_per_action", "url", "stream",
        ],
        "stream": [
            "file", "rate_hz", "num_samples", "deadline_ms", "model", "seed", "speed", "out", "url",
        ],
        "convert": ["file", "out", "skeleton", "fps", "fix_bones"],
    }  # fmt: skip
