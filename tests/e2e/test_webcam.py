"""The page's webcam in a real browser with a made-up camera, before a real server.

MediaPipe itself runs where npm has put it, with a small model of our own (`pose_task.py`), and
Google's model is loaded where `make webcam` has put it. What is ours behind MediaPipe is tested
with landmarks as a camera gives them, noisy and with gaps.
"""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browsing import (
    PATIENCE_MS,
    Server,
    chromium,
    needs_chromium,
    open_page,
    running,
    slide,
    sync_api,
)
from pose_task import RIGHT_ELBOW, RIGHT_WRIST, write_pose_task
from tiny_bundles import standing_pose

from models.motion.axes import Axes
from models.motion.skeleton import BODY21, SENT_ORDERS, SKELETONS, joint_map

expect = sync_api.expect

WEB = Path(__file__).parents[2] / "web"
PACKAGE = WEB / "node_modules/@mediapipe/tasks-vision"
OURS = WEB / "mediapipe"
FPS = 30.0
KEY = "hush/+~?"  # which the page tells over its WebSocket, too
MEDIAPIPE = SKELETONS["mediapipe33"]
RIGHT_FOREARM, NOISE_M = (16, 18, 20, 22), 0.015

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the operator has named in POSEFUTURES_POSE_LANDMARKER; tests put files into it."""
    return tmp_path_factory.mktemp("mediapipe")


@pytest.fixture(scope="module")
def server(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with running(
        tmp_path_factory.mktemp("bundles"), pose_landmarker=folder, api_keys=KEY
    ) as server:
        yield server


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator["sync_api.Browser"]:
    """Has a camera before which everything turns red and black again."""
    film = tmp_path_factory.mktemp("camera") / "film.y4m"
    write_film(film)
    camera = f"--use-file-for-fake-video-capture={film}"
    with chromium("--use-fake-device-for-media-stream", camera) as browser:
        yield browser


@pytest.fixture
def complaints() -> list[str]:
    return []


@pytest.fixture
def page(browser, server, complaints: list[str]) -> Iterator["sync_api.Page"]:
    with open_page(browser, server, complaints, permissions=["camera"], key=KEY) as page:
        yield page


class Talk:
    """What goes over the page's WebSocket."""

    def __init__(self, page: "sync_api.Page") -> None:
        self.sent: list[dict[str, Any]] = []
        self.heard: list[dict[str, Any]] = []
        page.on("websocket", self._listen)

    def _listen(self, socket: "sync_api.WebSocket") -> None:
        socket.on("framesent", lambda text: self.sent.append(json.loads(text)))
        socket.on("framereceived", lambda text: self.heard.append(json.loads(text)))

    def frames(self) -> dict[float, np.ndarray]:
        """The poses that were sent (33, 3), by their seconds."""
        frames = [message for message in self.sent if message["type"] == "frame"]
        return {message["t"]: np.array(message["pose"]) for message in frames}

    def answers(self) -> list[dict[str, Any]]:
        return [message for message in self.heard if message["type"] == "futures"]


def write_film(path: Path, *, width: int = 320, height: int = 240, num_frames: int = 60) -> None:
    """Pictures of one colour, which turns from black to red and back, as YUV4MPEG2."""
    with path.open("wb") as film:
        film.write(f"YUV4MPEG2 W{width} H{height} F30:1 Ip A1:1 C420jpeg\n".encode())
        for red in 0.5 - 0.5 * np.cos(2.0 * np.pi * np.arange(num_frames) / num_frames):
            luma = bytes([int(76 * red)]) * (width * height)
            chroma = [bytes([int(128 + at * red)]) * (width * height // 4) for at in (-43, 127)]
            film.write(b"FRAME\n" + luma + b"".join(chroma))


def standing() -> np.ndarray:
    """(33, 3) a person who faces the camera, as MediaPipe has it: y down, hips at the origin."""
    weights, _ = joint_map(BODY21, MEDIAPIPE)
    pose = np.empty((33, 3))
    pose[list(SENT_ORDERS["mediapipe33"])] = weights @ (standing_pose() * [-1.0, -1.0, 1.0])
    pose = Axes(up="-y").from_metres(pose)
    return np.asarray(pose - pose[[23, 24]].mean(axis=0))


def camera_landmarks(num_frames: int) -> list[list[list[float]] | None]:
    """Somebody who waves the right forearm every two seconds: noisy, and now and then not seen."""
    random = np.random.default_rng(0)
    poses = np.repeat(standing()[None], num_frames, axis=0)
    angle = 1.5 + 0.7 * np.sin(np.pi * np.arange(num_frames) / FPS)  # of the forearm from hanging
    turned = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    elbow = poses[:, RIGHT_ELBOW, :2]
    for joint in RIGHT_FOREARM:
        forearm = poses[:, joint, :2] - elbow
        poses[:, joint, :2] = elbow + np.einsum("ijt,tj->ti", turned, forearm)
    poses += random.normal(scale=NOISE_M, size=poses.shape)
    lost = random.random(num_frames) < 0.1
    lost[np.arange(num_frames) % 100 > 90] = True
    return [None if gone else pose.tolist() for gone, pose in zip(lost, poses, strict=True)]


PLAYED = """\
const poses = %s;
export const FilesetResolver = { forVisionTasks: async () => null };
export const PoseLandmarker = {
  createFromOptions: async () => {
    let began = null;
    const detectForVideo = (video, ms) => {
      began ??= ms;
      const pose = poses[Math.round((ms - began) * 0.03) %% poses.length];
      return { worldLandmarks: pose ? [pose.map(([x, y, z]) => ({ x, y, z }))] : [] };
    };
    return { detectForVideo, close() {} };
  },
};
"""

EVEN_TIMES = """() => {
    let clock = 0;  // however slowly a machine draws
    HTMLVideoElement.prototype.requestVideoFrameCallback = (seen) =>
        setTimeout(() => seen(clock += 1000 / 30), 33);
}"""


@pytest.fixture
def landmarks(folder: Path) -> list[list[list[float]] | None]:
    """What is seen by a MediaPipe that plays them, however slowly it is asked."""
    seen = camera_landmarks(600)
    (folder / "vision_bundle.mjs").write_text(PLAYED % json.dumps(seen))
    (folder / "pose_landmarker.task").touch()
    return seen


@pytest.fixture
def runtime(folder: Path) -> Path:
    """MediaPipe itself, into which a test puts a model."""
    if not PACKAGE.is_dir():
        pytest.skip("needs `npm ci` in web/, for MediaPipe")
    shutil.copy(PACKAGE / "vision_bundle.mjs", folder)
    shutil.copytree(PACKAGE / "wasm", folder / "wasm", dirs_exist_ok=True)
    return folder


def until_answers(page: "sync_api.Page", talk: Talk, count: int, *, num_frames: int = 0) -> None:
    for _ in range(PATIENCE_MS // 50):
        if len(talk.answers()) >= count and len(talk.frames()) >= num_frames:
            return
        page.wait_for_timeout(50)  # in which what the socket says is heard
    pytest.fail(f"{len(talk.answers())} of {count} answers came to {len(talk.frames())} frames")


def test_noisy_landmarks_with_gaps_are_calmed_and_give_futures_without_jumps(
    page, landmarks, complaints
):
    page.evaluate(EVEN_TIMES)
    talk = Talk(page)
    page.click("#webcam")
    until_answers(page, talk, 15, num_frames=100)  # in which the arm has gone up and down
    frames = talk.frames()
    sent, seen = np.array([*frames.values()])[30:], np.array([pose for pose in landmarks if pose])

    still = [joint for joint in range(33) if joint not in RIGHT_FOREARM]
    noise = sent[:, still][..., [0, 2]].std(axis=0)  # the lowest joint is put on the ground
    assert noise.mean() < 0.7 * NOISE_M
    assert np.ptp(sent[:, RIGHT_WRIST, 1]) > 0.6 * np.ptp(seen[:, RIGHT_WRIST, 1])  # it is followed
    lengths = bone_lengths_of(sent)
    assert np.diff(lengths, axis=0).std() < 0.05 * np.diff(bone_lengths_of(seen), axis=0).std()

    start, *_ = talk.sent
    assert (start["type"], start["rate_hz"]) == ("start", 10)
    answers = talk.answers()
    assert (np.diff([answer["t"] for answer in answers]) > 0.0).all()
    for answer in answers:
        futures = np.array(answer["answer"]["futures"])
        jump = np.linalg.norm(futures[:, 0] - frames[answer["t"]], axis=-1)
        assert jump.max() < 0.05, answer["t"]
    assert complaints == []


def bone_lengths_of(sent: np.ndarray) -> np.ndarray:
    poses = sent[:, list(SENT_ORDERS["mediapipe33"])]
    return np.linalg.norm(poses[:, 1:] - poses[:, list(MEDIAPIPE.parents)[1:]], axis=-1)


def test_mediapipe_runs_in_the_page_and_what_it_sees_is_predicted(page, runtime, complaints):
    body = standing()
    write_pose_task(runtime / "pose_landmarker.task", body)
    talk = Talk(page)
    page.click("#webcam")
    until_answers(page, talk, 2)
    expect(page.locator("#video")).to_be_visible()
    expect(page.locator("#motion-text")).to_contain_text("as the camera sees you")
    for pose in talk.frames().values():
        on_ground = body - [0.0, body[:, 1].max(), 0.0]
        off = np.linalg.norm(pose - on_ground, axis=-1)
        assert off[[0, 11, 12, 23, 24, 27, 28]].max() < 0.02  # the arm alone goes up when it is red
    assert complaints == []
    page.click("#webcam")
    expect(page.locator("#video")).to_be_hidden()
    expect(page.locator("#webcam")).to_have_attribute("aria-pressed", "false")


@pytest.mark.skipif(
    not (OURS / "pose_landmarker.task").is_file(), reason="needs Google's model: `make webcam`"
)
def test_the_model_of_google_is_loaded(page, runtime, complaints):
    shutil.copy(OURS / "pose_landmarker.task", runtime)
    page.click("#webcam")
    expect(page.locator("#video")).to_be_visible()  # which it is once the model has been read
    page.wait_for_timeout(2000)  # in which nobody is seen, and nothing goes wrong
    expect(page.locator("#notice")).to_be_hidden()
    assert complaints == []


@pytest.mark.usefixtures("landmarks")
def test_files_that_are_not_there_are_named(page, folder):
    (folder / "pose_landmarker.task").unlink()
    page.click("#webcam")
    expect(page.locator("#notice-text")).to_contain_text("does not have pose_landmarker.task")
    expect(page.locator("#webcam")).to_have_attribute("aria-pressed", "false")


@pytest.mark.usefixtures("landmarks")
def test_a_camera_that_is_denied_is_told_in_a_sentence(browser, server, complaints):
    with open_page(browser, server, complaints, permissions=[], key=KEY) as page:
        page.click("#webcam")
        expect(page.locator("#notice-text")).to_contain_text("was not allowed")
        expect(page.locator("#webcam")).to_have_attribute("aria-pressed", "false")
        slide(page, "#seed", 8)  # the motion that was there goes on
        page.locator('#timing[data-seed="8"]').wait_for()
    assert complaints == []


@pytest.mark.usefixtures("landmarks")
def test_a_demo_that_is_chosen_while_the_camera_comes_ends_it(page):
    page.evaluate(
        """() => {
            const { mediaDevices } = navigator;
            const ask = mediaDevices.getUserMedia.bind(mediaDevices);
            mediaDevices.getUserMedia = async (wanted) => {
                await new Promise((go) => { window.allow = go; });
                window.stream = await ask(wanted);
                return window.stream;
            };
        }"""
    )
    page.click("#webcam")
    page.wait_for_function("() => window.allow")
    page.click("[data-demo=hello]")
    expect(page.locator("#webcam")).to_have_attribute("aria-pressed", "false")
    page.evaluate("() => window.allow()")
    page.wait_for_function("() => window.stream?.getTracks().every((t) => t.readyState == 'ended')")
    expect(page.locator("#motion-text")).to_contain_text("hello")


@pytest.mark.usefixtures("landmarks")
def test_who_was_watched_can_be_told_what_to_do(page):
    page.evaluate(EVEN_TIMES)
    talk = Talk(page)
    page.click("#webcam")
    until_answers(page, talk, 3)
    page.locator("label", has=page.locator("#ask-perform")).click()
    expect(page.locator("#webcam")).to_have_attribute("aria-pressed", "false")
    slide(page, "#num-samples", 2)
    page.click("[data-action=wave-both-hands]")
    page.click("#perform")
    expect(page.locator("#script li small")).to_contain_text(" s")
