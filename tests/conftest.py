"""Fixtures that several folders of tests share."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from in_memory import Service
from tiny_bundles import X_T_SHAPE, write_actions_bundle, write_diffusion_bundle, write_still_bundle

settings.register_profile("untimed", deadline=None)  # machines are noisy
settings.load_profile("untimed")


@pytest.fixture(scope="session")
def bundles(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the bundles ``diffusion`` (the default) and ``still``."""
    folder = tmp_path_factory.mktemp("bundles")
    write_still_bundle(folder / "still")
    write_diffusion_bundle(folder / "diffusion")
    (folder / "DEFAULT").write_text("diffusion\n")
    return folder


@pytest.fixture(scope="session")
def stochastic_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A diffusion bundle with eta = 1 and a variance for each direction of its noise."""
    folder = tmp_path_factory.mktemp("stochastic") / "stochastic"
    return write_diffusion_bundle(folder, eta=1.0, directions=X_T_SHAPE[0])


@pytest.fixture(scope="session")
def actions_bundle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle that performs three actions, of lengths that depend on the noise."""
    return write_actions_bundle(tmp_path_factory.mktemp("actions") / "actions")


@pytest.fixture(scope="session")
def bundles_with_actions(
    bundles: Path, actions_bundle: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """A folder with ``actions``, the first by default, ``diffusion``, the second, and ``still``."""
    folder = shutil.copytree(bundles, tmp_path_factory.mktemp("with-actions") / "bundles")
    shutil.copytree(actions_bundle, folder / "actions")
    (folder / "DEFAULT").write_text("actions\ndiffusion\n")
    return folder


@pytest.fixture(scope="session")
def performing_service(bundles_with_actions: Path) -> Iterator[Service]:
    """The whole application on the bundles ``actions``, ``diffusion`` and ``still``, ready."""
    with Service.of(bundles_with_actions) as running:
        running.wait_until_loaded()
        yield running


@pytest.fixture(scope="session")
def service(bundles: Path) -> Iterator[Service]:
    """The whole application on the bundles ``diffusion`` and ``still``, ready."""
    with Service.of(bundles) as running:
        running.wait_until_loaded()
        yield running
