"""Makes the pictures of the page in docs/: ``PYTHONPATH=tests python -m screenshots``, then look.

Of the bundles that ship, so they are made anew when those or the page have changed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from browsing import ANSWERED, Server, chromium, slide, sync_api

DOCS = Path(__file__).parents[1] / "docs"
DESK = {"viewport": {"width": 1280, "height": 800}, "color_scheme": "dark"}
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "device_scale_factor": 1.2,
    "color_scheme": "light",
}
FPS, NOW = 30, 82  # of the demo, and the frame in it that is now
STILL_MS = 3000  # without another frame, however slowly they are drawn


def main() -> None:
    """Write all of them."""
    server = Server()
    try:
        server.start()
        with chromium() as browser:
            make(browser, server.url)
    finally:
        server.stop()


def make(browser: "sync_api.Browser", url: str) -> None:
    """Futures by themselves, against the truth with regions, performed, and on a phone."""
    with opened(browser, url, DESK) as page:
        look(page, seed=21, num_samples=30, ahead_s=1.9)
        shoot(page, "page.png")
        page.check("#show-regions")
        page.check("#show-truth")
        page.locator("#modes button").first.click()
        slide(page, "#playhead", NOW / FPS + 1.0)
        page.locator("#show-truth").scroll_into_view_if_needed()
        shoot(page, "page_regions.png")
    with opened(browser, url, DESK) as page:
        page.locator("label", has=page.locator("#ask-perform")).click()
        for action in ("walk-turn-left", "wave-both-hands", "run"):
            page.click(f"[data-action={action}]")
        page.click("#perform")
        page.locator('#timing[data-futures="8"]').wait_for()
        slide(page, "#playhead", NOW / FPS + 2.2)
        shoot(page, "page_actions.png")
    with opened(browser, url, PHONE) as page:
        look(page, seed=21, num_samples=20, ahead_s=1.7)
        shoot(page, "page_phone.png")


@contextmanager
def opened(browser: "sync_api.Browser", url: str, options: Any) -> Iterator["sync_api.Page"]:
    page = browser.new_page(**options, reduced_motion="reduce")
    page.goto(url)
    page.locator(ANSWERED).wait_for()
    yield page
    page.close()


def look(page: "sync_api.Page", *, seed: int, num_samples: int, ahead_s: float) -> None:
    """Ask for that many futures, and look at them so long after now."""
    slide(page, "#now", NOW)
    slide(page, "#num-samples", num_samples)
    rest(page)  # so that the page says how long an answer takes, not software that draws
    slide(page, "#seed", seed)
    page.locator(f'#timing[data-futures="{num_samples}"][data-seed="{seed}"]').wait_for()
    slide(page, "#playhead", NOW / FPS + ahead_s)


def rest(page: "sync_api.Page") -> None:
    drawn = None
    while drawn != (drawn := page.get_attribute("#canvas", "data-drawn")):
        page.wait_for_timeout(STILL_MS)


def shoot(page: "sync_api.Page", name: str) -> None:
    rest(page)
    page.screenshot(path=DOCS / name)


if __name__ == "__main__":
    main()
