"""The page for browsers, which `npm run build` in web/ makes, and its files."""

from pathlib import Path

from fastapi import FastAPI, Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles
from starlette.types import Scope

PATH = "/"
FILES_PATH = "/viewer"

_FOLDER = Path(__file__).parents[1] / "viewer"
_HEADERS = {
    # No other host and no inline script; MediaPipe compiles WebAssembly.
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'wasm-unsafe-eval'; "
    "img-src 'self' data: blob:; object-src 'none'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'self'",
    "Cache-Control": "no-cache",  # asked for each time, and 304 unless it has changed
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}


class _Files(StaticFiles):
    async def get_response(self, path: str, scope: Scope) -> Response:
        response = await super().get_response(path, scope)
        response.headers.update(_HEADERS)
        return response


def add_page(app: FastAPI, *, pose_landmarker: Path | None) -> None:
    """Serve the page, its files and, where there is a folder of them, those of its webcam."""
    files = _Files(directory=_FOLDER)
    if pose_landmarker is not None:
        app.mount(f"{FILES_PATH}/mediapipe", _Files(directory=pose_landmarker))
    app.mount(FILES_PATH, files)

    @app.api_route(PATH, methods=["GET", "HEAD"], include_in_schema=False)
    async def page(request: Request) -> Response:
        return await files.get_response("index.html", request.scope)
