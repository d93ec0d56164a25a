"""The page in a real browser, before a real server with the bundles that ship."""

import base64
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from browsing import (
    DESK,
    PATIENCE_MS,
    Server,
    chromium,
    needs_chromium,
    open_page,
    running,
    slide,
    sync_api,
)
from live import until
from tiny_bundles import walking, walking_in_a_scene

from models.motion.formats.bvh import write_bvh
from models.motion.formats.files import read_motion, write_motion
from models.motion.motion import Motion
from models.motion.skeleton import BODY21

expect = sync_api.expect

pytestmark = needs_chromium


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with running(tmp_path_factory.mktemp("bundles")) as server:
        yield server


@pytest.fixture(scope="module")
def browser() -> Iterator["sync_api.Browser"]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def complaints() -> list[str]:
    """What the browser's console says is wrong."""
    return []


@pytest.fixture(scope="module")
def opened(
    browser: "sync_api.Browser", server: Server, complaints: list[str]
) -> Iterator["sync_api.Page"]:
    """The page as it opens: futures are on it, and nothing is wrong."""
    permissions = ["clipboard-read", "clipboard-write"]
    with open_page(browser, server, complaints, permissions=permissions) as page:
        assert complaints == []
        yield page


@pytest.fixture
def page(opened: "sync_api.Page", complaints: list[str]) -> "sync_api.Page":
    """The open page with a demo's futures on it, whatever was done with it before."""
    complaints.clear()
    opened.set_viewport_size(DESK)
    opened.locator("label", has=opened.locator("#ask-predict")).click()
    slide(opened, "#seed", 7)
    slide(opened, "#num-samples", 20)
    slide(opened, "#num-steps", usual_steps(opened))
    opened.select_option("#sample", "all")
    opened.click("[data-demo=hello]")
    expect(opened.locator("#motion-text")).to_contain_text("hello")
    opened.click("[data-demo=stroll-and-wave]")
    expect(opened.locator("#motion-text")).to_contain_text("stroll")
    opened.locator('#timing[data-futures="20"][data-seed="7"]').wait_for()
    return opened


def usual_steps(page: "sync_api.Page") -> int:
    """The denoising steps that the model runs unless it is told another number."""
    return int(page.locator("#num-steps").get_attribute("data-usual"))


def seek(page: "sync_api.Page", seconds: float) -> None:
    """Look at a time from now, and stay there."""
    ahead = "() => Number(document.querySelector('#now').value)"
    slide(page, "#playhead", page.evaluate(ahead) / 30.0 + seconds)


def picture(page: "sync_api.Page") -> np.ndarray:
    """(height, width, 4) the scene as it has just been drawn."""
    width, height, data = page.evaluate(
        """() => new Promise((read) => {
            const canvas = document.querySelector('#canvas');
            const seek = document.querySelector('#playhead');
            seek.dispatchEvent(new Event('input'));
            requestAnimationFrame(() => {
                const copy = new OffscreenCanvas(canvas.width, canvas.height).getContext('2d');
                copy.drawImage(canvas, 0, 0);
                const { width, height } = canvas;
                const { data } = copy.getImageData(0, 0, width, height);
                let text = '';
                for (let i = 0; i < data.length; i += 8192)
                    text += String.fromCharCode(...data.subarray(i, i + 8192));
                read([width, height, btoa(text)]);
            });
        })"""
    )
    return np.frombuffer(base64.b64decode(data), np.uint8).reshape(height, width, 4)


def coloured(image: np.ndarray) -> int:
    """How many pixels have the colour of a mode: the person and the ground are grey."""
    channels = image[..., :3].astype(int)
    spread = channels.max(axis=-1) - channels.min(axis=-1)
    return int(((spread > 60) & (image[..., 3] > 40)).sum())


def test_it_loads_draws_and_complains_of_nothing(page, complaints):
    page.uncheck("#show-trails")
    seek(page, -0.5)
    before = picture(page)
    seek(page, 1.0)
    after = picture(page)
    assert (before[..., 3] > 200).sum() > 300  # the person
    assert coloured(before) < 20
    assert coloured(after) > 500  # futures, which there are only after now
    assert complaints == []


def test_the_scrubber_crosses_now_by_keyboard(page):
    seek(page, 0.0)
    expect(page.locator("#clock")).to_have_text("now")
    page.locator("#canvas").focus()
    page.keyboard.press(".")
    expect(page.locator("#clock")).to_have_text("+0.03 s")
    page.keyboard.press(",")
    page.keyboard.press(",")
    expect(page.locator("#clock")).to_have_text("\N{MINUS SIGN}0.03 s")
    page.keyboard.press(" ")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    page.locator("#now").focus()
    frame = int(page.locator("#now").input_value())
    page.keyboard.press("ArrowRight")
    assert int(page.locator("#now").input_value()) == frame + 1


def test_the_number_of_futures_and_the_seed_are_what_the_sliders_say(page):
    slide(page, "#num-samples", 33)
    page.locator('#timing[data-futures="33"]').wait_for()
    assert page.locator("#sample option").count() == 34
    shares = page.locator("#modes b").all_inner_texts()
    assert sum(int(share.removesuffix(" %")) for share in shares) == pytest.approx(100, abs=2)
    slide(page, "#seed", 42)
    page.locator('#timing[data-seed="42"]').wait_for()
    seek(page, 1.5)
    everybody = coloured(picture(page))
    page.locator("#modes button").last.click()
    expect(page.locator("#modes button").last).to_have_attribute("aria-pressed", "true")
    assert coloured(picture(page)) < everybody


def test_two_actions_are_composed_and_performed(page):
    page.locator("label", has=page.locator("#ask-perform")).click()
    page.click("[data-action=walk-turn-left]")
    page.click("[data-action=wave-both-hands]")
    slide(page, "#num-samples", 2)
    page.click("#perform")
    page.locator('#timing[data-futures="2"]').wait_for()
    entries = page.locator("#script li")
    for entry, name in zip(entries.all(), ("walk turn left", "wave both hands"), strict=True):
        expect(entry).to_contain_text(name)
        expect(entry.locator("small")).to_contain_text(" s")  # how long it takes


def test_who_runs_away_stays_in_view(page):
    page.locator("label", has=page.locator("#ask-perform")).click()
    page.locator("#clear").evaluate("button => button.click()")  # which may have nothing to do
    page.click("[data-action=run]")
    page.click("[data-action=run]")
    slide(page, "#num-samples", 3)
    page.click("#perform")
    page.locator('#timing[data-futures="3"]').wait_for()
    page.uncheck("#show-trails")
    seek(page, 4.0)  # some twenty metres away
    until(lambda: coloured(picture(page)) > 200, patience_s=PATIENCE_MS / 1000)


@pytest.mark.parametrize("kind", ["bvh", "npz", "json"])
def test_a_dropped_motion_is_predicted_in_its_own_skeleton(page, tmp_path, complaints, kind):
    motion = Motion(name="mine", skeleton=BODY21, positions=walking(90, fps=60.0), fps=60.0)
    write_motion(tmp_path / f"mine.{kind}", motion)
    drop(page, tmp_path / f"mine.{kind}")
    expect(page.locator("#motion-text")).to_contain_text("mine: 1.5 s")
    slide(page, "#seed", 23)
    page.locator('#timing[data-seed="23"]').wait_for()
    seek(page, 0.7)
    assert coloured(picture(page)) > 200
    assert complaints == []


def test_what_is_drawn_of_a_scene_is_the_body_and_the_way_of_its_hips(page, tmp_path):
    write_bvh(tmp_path / "far.bvh", walking_in_a_scene(90, name="far", away_m=5.0))
    drop(page, tmp_path / "far.bvh")
    expect(page.locator("#motion-text")).to_contain_text("far: 3.0 s")
    page.locator('#timing[data-futures="20"]').wait_for()
    page.check("#show-trails")
    seek(page, -0.5)
    assert coloured(picture(page)) > 100  # the futures' ways, which a root that stands has none of


def test_a_file_that_is_no_motion_is_refused_in_a_sentence(page, tmp_path):
    (tmp_path / "broken.bvh").write_text("no hierarchy")
    drop(page, tmp_path / "broken.bvh")
    expect(page.locator("#notice-text")).to_contain_text("broken.bvh")
    page.click("#notice-close")
    expect(page.locator("#notice")).to_be_hidden()


def drop(page: "sync_api.Page", file: Path) -> None:
    transfer = page.evaluate_handle(
        """([name, content]) => {
            const bytes = Uint8Array.from(atob(content), letter => letter.charCodeAt(0));
            const dropped = new DataTransfer();
            dropped.items.add(new File([bytes], name));
            return dropped;
        }""",
        [file.name, base64.b64encode(file.read_bytes()).decode()],
    )
    page.dispatch_event("#stage", "drop", {"dataTransfer": transfer})


def test_the_steps_are_the_model_s_own_until_the_slider_says_others(page, server):
    models = httpx.get(f"{server.url}/models").json()["models"]
    answering = next(model for model in models if not model["actions"])
    assert usual_steps(page) == answering["default_steps"] < answering["num_steps"]
    assert int(page.locator("#num-steps").get_attribute("max")) == answering["num_steps"]
    for steps, asked in ((usual_steps(page), None), (1, 1), (answering["num_steps"],) * 2):
        with page.expect_request("**/predict") as sent:
            slide(page, "#num-steps", steps)
            slide(page, "#seed", 40 + steps)
            page.locator(f'#timing[data-seed="{40 + steps}"]').wait_for()
        assert sent.value.post_data_json.get("num_steps") == asked


def test_the_denoiser_is_watched_step_by_step(page):
    slide(page, "#num-steps", 10)
    page.click("#denoise")
    page.locator('#preview[data-step="9"]').wait_for(state="attached")
    expect(page.locator("#preview")).to_be_hidden()  # then the answer is there
    seek(page, 1.0)
    assert coloured(picture(page)) > 500


def test_the_future_that_is_shown_alone_is_saved_as_a_bvh_that_can_be_read(page, tmp_path):
    page.select_option("#sample", "3")
    with page.expect_download() as saved:
        page.click("#save-bvh")
    saved.value.save_as(tmp_path / saved.value.suggested_filename)
    assert saved.value.suggested_filename.endswith("-4.bvh")
    motion = read_motion(tmp_path / saved.value.suggested_filename)
    assert motion.num_frames == 60
    assert motion.duration == pytest.approx(2.0, abs=0.05)


def test_what_is_copied_runs(page):
    page.click("#copy-python")
    expect(page.locator("#take-text")).to_contain_text("Copied")
    program = page.evaluate("() => navigator.clipboard.readText()")
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert run.stdout.startswith("20 futures by"), run.stderr


def test_it_says_when_the_server_is_away_and_goes_on_when_it_is_back(page, server):
    server.stop()
    slide(page, "#num-samples", 11)
    expect(page.locator("#server")).to_contain_text("The server is away")
    server.start()
    page.locator('#timing[data-futures="11"]').wait_for()
    expect(page.locator("#server")).to_contain_text("2 models ready")


def test_it_fits_a_phone_and_the_keyboard_reaches_the_controls(page):
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("() => document.documentElement.scrollWidth") == 390
    page.locator("#save-json").focus()  # the last of the controls, beside which the scene is seen
    expect(page.locator("#canvas")).to_be_in_viewport(ratio=1)
    expect(page.locator("#save-json")).to_be_in_viewport(ratio=1)
    page.locator("#play").focus()
    reached = []
    for _ in range(12):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("() => document.activeElement.id"))
    for control in ("now", "playhead", "open", "webcam", "ask-predict", "model", "num-samples"):
        assert control in reached


def test_without_mediapipe_the_webcam_says_which_files_are_missing(page):
    page.click("#webcam")
    expect(page.locator("#notice-text")).to_contain_text("POSEFUTURES_POSE_LANDMARKER")
    expect(page.locator("#notice-text")).to_contain_text("vision_bundle.mjs")
