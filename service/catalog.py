"""The bundles of a folder: loaded and warmed up one by one, each ready or refused by itself."""

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from models.bundle import CARD_FILE, BundleError, Manifest, ManifestError, read_manifest
from service.engine.engine import Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Request
from service.errors import EngineError, UnavailableError, UnknownModelError
from service.worker import Worker

DEFAULT_FILE = "DEFAULT"

_log = logging.getLogger(__name__)


@dataclass(kw_only=True, slots=True, eq=False)
class Entry:
    """A bundle of the folder; ``worker`` is there once it is ready."""

    name: str
    state: Literal["loading", "ready", "refused"] = "loading"
    reason: str | None = None
    manifest: Manifest | None = None
    card: str = ""
    worker: Worker | None = field(default=None, repr=False)


class Catalog:
    """Every bundle of a folder by name; answers while it still loads."""

    def __init__(self, folder: Path, *, default_model: str | None, threads: int) -> None:
        self._folder = folder
        self._threads = threads
        self.entries = {name: Entry(name=name) for name in bundle_names(folder)}
        self.default_model = default_model or _default_of(folder, list(self.entries))
        if self.default_model is not None:
            self.entry(self.default_model)

    @property
    def state(self) -> Literal["loading", "ready", "unavailable"]:
        """Ready once every bundle was tried and one can answer."""
        states = {entry.state for entry in self.entries.values()}
        if "loading" in states:
            return "loading"
        return "ready" if "ready" in states else "unavailable"

    def load(self) -> None:
        """Load every bundle, the default one first; a bundle that cannot be used is refused."""
        for entry in sorted(self.entries.values(), key=lambda e: e.name != self.default_model):
            try:
                self._load(entry)
            except (BundleError, EngineError, ValueError) as error:
                _refuse(entry, str(error))
            except OSError as error:  # its text holds the whole path, which is nobody's business
                _refuse(entry, f"{entry.name}: a file cannot be read: {error.strerror}.")

    def entry(self, name: str) -> Entry:
        """The bundle of this name, in whatever state.

        Raises:
            UnknownModelError: there is none.
        """
        if name not in self.entries:
            raise UnknownModelError(
                pointer="/model",
                found=repr(name[:40]),
                expected=f"must be one of {', '.join(self.entries) or 'none: no bundle is here'}",
            )
        return self.entries[name]

    def ready(self, name: str | None) -> tuple[Manifest, Worker]:
        """The bundle of this name, or the default one, which can answer.

        Raises:
            UnknownModelError: there is none of this name.
            UnavailableError: it is loading, or was refused.
        """
        wanted = name if name is not None else self.default_model
        if wanted is None:
            raise UnavailableError("model: found no bundle on this server; it needs at least one.")
        entry = self.entry(wanted)
        if entry.state == "loading":
            raise UnavailableError(f"model: {wanted} is loading; try again in a second.")
        if entry.manifest is None or entry.worker is None:
            raise UnavailableError(f"model: the bundle {wanted} was refused: {entry.reason}")
        return entry.manifest, entry.worker

    def stop(self) -> None:
        """Stop every worker; what they had not finished fails."""
        for entry in self.entries.values():
            if entry.worker is not None:
                entry.worker.stop()

    def _load(self, entry: Entry) -> None:
        engine, card = load_bundle(self._folder / entry.name, threads=self._threads)
        entry.manifest, entry.card = engine.manifest, card
        warm_up(engine)
        entry.worker = Worker(engine)
        entry.state = "ready"


def _refuse(entry: Entry, reason: str) -> None:
    entry.reason = reason
    entry.state = "refused"
    _log.error("bundle %s is refused: %s", entry.name, reason)


def bundle_names(folder: Path) -> list[str]:
    """The folders that are bundles, or should be, by name."""
    if not folder.is_dir():
        return []
    return sorted(p.name for p in folder.iterdir() if p.is_dir() and p.name[0] not in "._")


def load_bundle(folder: Path, *, threads: int) -> tuple[Engine, str]:
    """The engine of a bundle, and its model card.

    Raises:
        BundleError: the bundle is damaged, or its name is not its folder's.
        EngineError: a graph cannot be loaded.
    """
    manifest = read_manifest(folder)
    if manifest.name != folder.name:
        raise ManifestError(
            f"{folder.name}/manifest.json: name: found {manifest.name!r}; it must be the folder's."
        )
    card = folder / CARD_FILE
    text = card.read_text(encoding="utf-8", errors="replace") if card.is_file() else ""
    return Engine(Runner(manifest, folder, threads=threads)), text


def warm_up(engine: Engine) -> None:
    """Run every graph once, on a body that stands still.

    Raises:
        EngineError: a graph does not run, or gives NaN.
    """
    manifest = engine.manifest
    generator = np.random.Generator(np.random.Philox(key=[0, 0]))
    pose = generator.uniform(0.0, 1.0, (len(manifest.skeleton.joints), 3)).astype(np.float32)
    predict(engine, Request(observation=np.repeat(pose[None], manifest.num_observed, axis=0)))


def _default_of(folder: Path, names: list[str]) -> str | None:
    file = folder / DEFAULT_FILE
    if file.is_file():
        return file.read_text(encoding="utf-8").strip()
    return names[0] if names else None
