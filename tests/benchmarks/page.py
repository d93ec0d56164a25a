"""How soon the page answers its sliders: ``PYTHONPATH=tests python -m benchmarks.page``.

In Chromium, each slider is moved again and again. From its event it takes until the answer is there
(the round trip, of which the server tells its own part), until its figures are laid out, until
their picture has been asked of the graphics card, and until it is there, for which a pixel of it is
read. Where there is no card, as on most servers, the last is software's work, not the page's.
"""

import os
from collections.abc import Iterator
from itertools import cycle, islice
from pathlib import Path
from statistics import median, quantiles
from tempfile import TemporaryDirectory
from typing import Annotated

import typer
from browsing import ANSWERED, chromium, running, sync_api

WANTED_MS = 200.0
VALUES = {  # each unlike the one before it; at the end all are as they were at first
    "num-samples": (50, 5, 35, 10, 20),
    "num-steps": (1, 8, 3, 5, 10),
    "seed": (1, 11, 31, 71, 7),
}
PARTS = ("server", "round trip", "laid out", "asked", "drawn")

MOVE = """([slider, value]) => new Promise((tell) => {
    const [canvas, timing] = [document.querySelector('#canvas'), document.querySelector('#timing')];
    const gl = canvas.getContext('webgl2');
    const moved = performance.now();
    const passed = () => performance.now() - moved;
    new MutationObserver((_, answers) => {
        answers.disconnect();
        const laidOut = passed();
        new MutationObserver((_, pictures) => {
            pictures.disconnect();
            const asked = passed();
            gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
            const drawn = passed();
            const ms = (words) => Number(timing.textContent.match(words + ' (\\\\d+) ms')[1]);
            tell([ms('server'), ms('round trip'), laidOut, asked, drawn]);
        }).observe(canvas, { attributeFilter: ['data-drawn'] });
    }).observe(timing, { childList: true });
    slider.value = value;
    slider.dispatchEvent(new Event('input', { bubbles: true }));
})"""


def main(
    *,
    moves: Annotated[int, typer.Option(min=2, help="of each slider")] = 30,
    width: Annotated[int, typer.Option(help="of the window, in pixels")] = 1280,
    height: Annotated[int, typer.Option()] = 800,
    scale: Annotated[float, typer.Option(help="pixels of the screen for one of the page")] = 1.0,
) -> None:
    """Print what the moves of each slider took, median and p90."""
    busy = os.getloadavg()[0]
    with TemporaryDirectory() as folder, running(Path(folder)) as server, chromium() as browser:
        page = browser.new_page(
            viewport={"width": width, "height": height},
            device_scale_factor=scale,
            reduced_motion="reduce",  # it stands still, a second after now
        )
        page.goto(server.url)
        page.locator(ANSWERED).wait_for()
        found = {slider: _moved(page, slider, moves) for slider in VALUES}
    print(f"{width} x {height}, scale {scale:g}; load average {busy:.1f} before\n")
    print(f"| ms, median (p90) of {moves} | {' | '.join(PARTS)} | of it drawing |")
    print("|---|" + "--:|" * (len(PARTS) + 1))
    for slider, times in found.items():
        print(f"| {slider} | {' | '.join(_cells(times))} |")
    worst = max(quantiles(_last(times), n=10)[-1] for times in found.values())
    met = "met" if worst < WANTED_MS else "not met"
    print(f"\nwanted: under {WANTED_MS:.0f} ms; worst p90 {worst:.0f} ms: {met}")


def _moved(page: "sync_api.Page", slider: str, moves: int) -> list[list[float]]:
    """For each move the milliseconds until each of the parts is done."""
    handle = page.query_selector(f"#{slider}")
    values: Iterator[int] = cycle(VALUES[slider])
    page.evaluate(MOVE, [handle, next(values)])  # the first is no measurement
    times = [page.evaluate(MOVE, [handle, value]) for value in islice(values, moves)]
    while handle is not None and int(handle.input_value()) != VALUES[slider][-1]:
        page.evaluate(MOVE, [handle, next(values)])
    return times


def _cells(times: list[list[float]]) -> list[str]:
    parts = list(zip(*times, strict=True))
    cells = [f"{median(part):.0f} ({quantiles(part, n=10)[-1]:.0f})" for part in parts]
    drawing = median((row[-1] - row[2]) / row[-1] for row in times)
    return [*cells, f"{drawing:.0%}"]


def _last(times: list[list[float]]) -> list[float]:
    return [row[-1] for row in times]


if __name__ == "__main__":
    typer.run(main)
