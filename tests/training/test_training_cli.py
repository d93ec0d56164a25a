"""The command line: its flags are frozen, and its errors are one line."""

import subprocess
import sys
from pathlib import Path

import pytest
import typer

from training.cli import RecipeError, app, load_recipe

FLAGS = {
    "prepare": {"--out", "--skeleton", "--fps"},
    "train": {"--store", "--out", "--device", "--seed", "--start-from"},
    "export": {"--store", "--out", "--licence", "--run", "--card", "--attribution", "--version"}
    | {"--machine"},
    "evaluate": {"--store", "--out", "--group", "--num-samples", "--num-steps", "--stride"}
    | {"--max-windows", "--seed", "--sheet"},
    "calibrate": {"--store", "--hold", "--group", "--samples", "--stride", "--max-windows"}
    | {"--seed"},
    "steps": {"--store", "--hold", "--out", "--samples", "--stride", "--max-windows", "--rounds"}
    | {"--seed"},
    "classifier": {"--store", "--out", "--updates"},
    "evaluate-actions": {"--store", "--classifier", "--out", "--hold", "--samples", "--histories"}
    | {"--actions-in-sequence", "--seed", "--sheet"},
}


def test_commands_and_flags_are_these():
    commands = typer.main.get_command(app).commands
    found = {
        name: {flag for option in command.params for flag in option.opts if flag.startswith("--")}
        for name, command in commands.items()
    }
    assert found == FLAGS


@pytest.mark.parametrize(
    "path", ["nothing", "no.such.module:tiny", "training.cli:load_recipe", "models.system:absent"]
)
def test_path_that_names_no_recipe_is_refused(path):
    with pytest.raises(RecipeError, match="recipe: found"):
        load_recipe(path)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train", "nothing", "--store", "x", "--out", "y"], "must be package.module:function"),
        (["prepare", "absent", "--out", "y"], "absent"),
        (["prepare", "absent", "--out", "y", "--skeleton", "dog"], "must be one of body21"),
        (["evaluate", "absent", "--store", "x", "--out", "y", "--group", "z"], "found no"),
    ],
)
def test_errors_are_one_line(arguments, message, tmp_path):
    command = Path(sys.executable).with_name("posefutures-train")
    run = subprocess.run([command, *arguments], cwd=tmp_path, capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert message in run.stderr
    assert run.stderr.startswith("error: ")
