"""A server in a process of its own, and the browser in which its page is looked at."""

import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from live import until

from service.settings import Settings

sync_api = pytest.importorskip("playwright.sync_api")

CHROMIUM = shutil.which("chromium")
FLAGS = (  # software rendering, as the machines of a CI have no GPU
    "--no-sandbox",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
START_S, PATIENCE_MS = 240.0, 60_000  # a gate's machine may be busy
DESK = {"width": 900, "height": 600}
ANSWERED = "#timing[data-futures]"

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")


class Server:
    """`posefutures serve` on one and the same port, however often it is started."""

    def __init__(self, **settings: object) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        self._settings = [f"POSEFUTURES_{name.upper()}={it}" for name, it in settings.items()]
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        program = [sys.executable, "-c", "from service.cli import app; app()"]
        self._process = subprocess.Popen(
            ["env", *self._settings, *program, "serve", f"--port={self.port}"],
            stderr=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
        )
        until(self._is_ready, patience_s=START_S)

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    def _is_ready(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz").is_success
        except httpx.TransportError:
            return False


@contextmanager
def running(folder: Path, **settings: object) -> Iterator[Server]:
    """Serves the two bundles that answer by default, which it links into ``folder``."""
    shipped = Settings().bundles
    shutil.copy(shipped / "DEFAULT", folder)
    for name in (shipped / "DEFAULT").read_text().split():
        (folder / name).symlink_to(shipped / name)
    server = Server(bundles=folder, **settings)
    try:
        server.start()
        yield server
    finally:
        server.stop()


@contextmanager
def chromium(*flags: str) -> Iterator["sync_api.Browser"]:
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=[*FLAGS, *flags])
        yield browser
        browser.close()


@contextmanager
def open_page(
    browser: "sync_api.Browser",
    server: Server,
    complaints: list[str],
    *,
    permissions: list[str],
    key: str | None = None,
) -> Iterator["sync_api.Page"]:
    """The page as it opens, with futures on it; the console tells ``complaints`` what is wrong."""
    context = browser.new_context(
        viewport=DESK,
        device_scale_factor=0.5,  # a quarter of the pixels: a CPU draws them
        reduced_motion="reduce",
        permissions=permissions,
        base_url=server.url,
    )
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    sync_api.expect.set_options(timeout=PATIENCE_MS)
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("console", lambda said: said.type == "error" and complaints.append(said.text))
    page.goto("/")
    if key is not None:
        page.fill("#key", key)
        page.press("#key", "Enter")
    page.locator(ANSWERED).wait_for()
    if key is not None:
        complaints.clear()  # of what was asked without it
    yield page
    context.close()


def slide(page: "sync_api.Page", slider: str, value: float) -> None:
    """What a hand does to a slider."""
    page.locator(slider).evaluate(
        "(slider, value) => { slider.value = value; slider.dispatchEvent(new Event('input')) }",
        value,
    )
