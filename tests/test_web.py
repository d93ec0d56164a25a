"""What is committed of the page is what its sources make: the client and the bundle."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
WEB = ROOT / "web"

pytestmark = pytest.mark.skipif(
    shutil.which("npm") is None or not (WEB / "node_modules").is_dir(),
    reason="needs Node.js, and `npm ci` in web/",
)


def npm(script: str, **variables: object) -> None:
    said = [f"{name}={value}" for name, value in variables.items()]
    command = ["env", *said, "npm", "run", script]
    run = subprocess.run(command, cwd=WEB, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and "demos" not in path.parts
    }


def assert_same(made: Path, committed: Path) -> None:
    new, old = contents(made), contents(committed)
    assert new.keys() == old.keys()
    stale = [name for name in new if new[name] != old[name]]
    assert not stale, f"{stale} in {committed.relative_to(ROOT)} are stale; `make page` makes them"


def test_the_sources_and_the_client_are_well_typed():
    npm("check")


def test_the_client_is_that_of_the_api(tmp_path):
    document = tmp_path / "openapi.json"
    document.write_bytes(subprocess.check_output([sys.executable, WEB / "openapi.py"], cwd=ROOT))
    npm("client", OPENAPI=document, CLIENT=tmp_path / "client")
    assert_same(tmp_path / "client", WEB / "client")


def test_the_page_is_that_of_the_sources(tmp_path):
    npm("build", OUT=tmp_path)
    assert_same(tmp_path, ROOT / "service/viewer")
