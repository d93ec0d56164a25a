"""The architecture, as tests: what import contracts cannot say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SYSTEMS = sorted(
    p.name for p in (ROOT / "models/systems").iterdir() if (p / "__init__.py").exists()
)
SOURCES = [
    p for room in ("service", "models", "training") for p in sorted((ROOT / room).rglob("*.py"))
]


def test_import_contracts_are_kept():
    """Runs import-linter; its report names the forbidden chain."""
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout


def test_server_starts_without_torch():
    """The serving image has no torch; neither may the import of the app."""
    code = "import sys; sys.modules['torch'] = None; import service.app"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


@pytest.mark.parametrize(
    "path",
    [p for p in SOURCES if p.relative_to(ROOT).parts[0] != "models"],
    ids=lambda p: str(p.relative_to(ROOT)),
)
def test_machinery_names_no_system(path):
    """No branch on a system's name, not even in a string."""
    assert not re.findall(rf"\b({'|'.join(SYSTEMS)})\b", path.read_text(), re.IGNORECASE)
