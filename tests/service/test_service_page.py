"""The page's files over HTTP; what they do is tested in a browser, in e2e/test_page.py."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from in_memory import Service

TYPES = {
    "/": "text/html; charset=utf-8",
    "/viewer/page.js": "text/javascript; charset=utf-8",
    "/viewer/style.css": "text/css; charset=utf-8",
    "/viewer/icon.svg": "image/svg+xml",
    "/viewer/LICENCES.txt": "text/plain; charset=utf-8",
    "/viewer/demos/hello.json": "application/json",
}


@pytest.fixture
def closed(bundles: Path, tmp_path: Path) -> Iterator[Service]:
    """Wants a key, and has files for the webcam."""
    (tmp_path / "vision_bundle.mjs").write_text("export {}")
    (tmp_path / "wasm").mkdir()
    (tmp_path / "wasm/vision.wasm").write_bytes(b"\0asm")
    with Service.of(bundles, api_keys="secret", pose_landmarker=tmp_path) as running:
        yield running


@pytest.mark.parametrize(("path", "media_type"), TYPES.items())
def test_each_file_has_its_type_and_may_reach_no_other_host(service, path, media_type):
    response = service.get(path)
    assert response.status_code == 200
    assert response.headers["content-type"] == media_type
    assert response.headers["content-security-policy"].startswith("default-src 'self';")
    assert service.request("HEAD", path).status_code == 200


def test_a_file_that_has_not_changed_is_not_sent_again(service):
    tag = service.get("/viewer/page.js").headers["etag"]
    again = service.request("GET", "/viewer/page.js", headers={"if-none-match": tag})
    assert (again.status_code, again.content) == (304, b"")


@pytest.mark.parametrize("path", ["/viewer", "/viewer/", "/viewer/demos/", "/viewer/../app.py"])
def test_folders_and_what_is_beside_them_are_not_found(service, path):
    response = service.get(path)
    assert response.status_code in (307, 404)
    assert b"demos" not in response.content or response.json()["status"] == 404


def test_the_page_leaves_the_api_as_it_was(service):
    assert service.get("/nothing").json()["type"] == "/problems/not-found"
    assert service.get("/predict").status_code == 405
    assert service.request("POST", "/").status_code == 405
    assert "content-security-policy" not in service.get("/docs").headers


def test_the_page_is_open_where_the_api_wants_a_key(closed):
    assert closed.get("/").status_code == 200
    assert closed.get("/viewer/page.js").status_code == 200
    assert closed.get("/models").status_code == 401


def test_the_operators_files_for_the_webcam_are_served(closed):
    bundle = closed.get("/viewer/mediapipe/vision_bundle.mjs")
    assert bundle.headers["content-type"].startswith("text/javascript")
    wasm = closed.get("/viewer/mediapipe/wasm/vision.wasm")
    assert wasm.headers["content-type"] == "application/wasm"


def test_without_them_they_are_not_found(service):
    assert service.get("/viewer/mediapipe/vision_bundle.mjs").status_code == 404


def test_the_page_may_run_webassembly_and_no_inline_script(service):
    policy = service.get("/").headers["content-security-policy"]
    assert "script-src 'self' 'wasm-unsafe-eval'" in policy
    assert "unsafe-inline" not in policy
    assert "<script>" not in service.get("/").text
