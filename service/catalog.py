"""The bundles of a folder: loaded and warmed up one by one, each ready or refused by itself."""

import logging
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Literal

import numpy as np

from models.bundle import (
    CARD_FILE,
    ActionsSpec,
    BundleError,
    Manifest,
    ManifestError,
    read_manifest,
)
from service.engine.engine import ROWS_PER_STEP, Engine, predict
from service.engine.runner import Runner
from service.engine.trajectory import Request, Result
from service.errors import (
    EngineError,
    UnavailableError,
    UnknownModelError,
    UnsuitableModelError,
)
from service.worker import Worker

DEFAULT_FILE = "DEFAULT"
GOLDEN_SAMPLES = 4

_log = logging.getLogger(__name__)


def _unlimited(engine: Engine) -> Worker:
    return Worker(engine, max_rows=sys.maxsize)


@dataclass(kw_only=True, slots=True, eq=False)
class Entry:
    """A bundle of the folder; ``worker`` is there once it is ready."""

    name: str
    state: Literal["loading", "ready", "refused"] = "loading"
    reason: str | None = None
    manifest: Manifest | None = None
    card: str = ""
    golden_digest: str | None = None
    """sha256 of the futures of the bundle's golden request, in hexadecimal."""
    worker: Worker | None = field(default=None, repr=False)

    def answers(self, *, with_actions: bool) -> bool:
        """Whether requests with actions, or those without, are for it; unread, it has none."""
        performs = self.manifest is not None and self.manifest.actions is not None
        return performs == with_actions


class Catalog:
    """Every bundle of a folder by name, with its manifest; answers while it still loads."""

    def __init__(
        self,
        folder: Path,
        *,
        default_model: str | None,
        threads: int = 1,
        rows_per_step: int = ROWS_PER_STEP,
        worker: Callable[[Engine], Worker] = _unlimited,
    ) -> None:
        """Read the manifests.

        Args:
            folder: where the bundles are.
            default_model: the preferred bundle; None leaves it to the folder.
            threads: cores of one call of a graph.
            rows_per_step: the most rows of one step.
            worker: starts a bundle's worker on its engine.
        """
        self._folder = folder
        self._threads = threads
        self._rows_per_step = rows_per_step
        self._worker = worker
        self._is_loaded = False
        self.entries = {name: Entry(name=name) for name in bundle_names(folder)}
        names = [default_model] if default_model else _preferred(folder, list(self.entries))
        self._preferred = [self.entry(name) for name in names]
        for entry in self.entries.values():
            with _refused_on_error(entry):
                entry.manifest, entry.card = read_bundle(folder / entry.name)

    @property
    def state(self) -> Literal["loading", "ready", "unavailable"]:
        """Ready once every bundle was tried, one can answer, and what answers is warm."""
        if not self._is_loaded:
            return "loading"
        states = {entry.state for entry in self.entries.values()}
        return "ready" if "ready" in states else "unavailable"

    @property
    def default_model(self) -> str | None:
        """The name of the bundle that predicts when a request names none."""
        entry = self.default(with_actions=False)
        return entry.name if entry else None

    def load(self, warm_up: Callable[[], object] = lambda: None) -> None:
        """Load every bundle, preferred ones first, and warm up what is to answer with them.

        A bundle that cannot be used is refused.
        """
        for entry in dict.fromkeys([*self._preferred, *self.entries.values()]):
            if entry.state == "loading":
                with _refused_on_error(entry):
                    self._load(entry)
            if entry.reason is not None:
                _log.error("bundle %s is refused: %s", entry.name, entry.reason)
        try:
            warm_up()
        finally:
            self._is_loaded = True

    def default(self, *, with_actions: bool) -> Entry | None:
        """The bundle for requests that name none: the first that is preferred and ready.

        Where actions are performed, or every preferred bundle is of the other kind, it may be one
        that is not preferred.
        """
        chosen = [e for e in self._preferred if e.answers(with_actions=with_actions)]
        if with_actions or not chosen:
            chosen += self._of_kind(with_actions=with_actions)
        return next((entry for entry in chosen if entry.state == "ready"), next(iter(chosen), None))

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

    def chosen(self, name: str | None, *, with_actions: bool) -> Entry:
        """The bundle of this name, or the default one, for requests with or without actions.

        Raises:
            UnknownModelError: there is none of this name.
            UnsuitableModelError: it is for the other kind of request.
            UnavailableError: there is none at all.
        """
        kind = "performs actions" if with_actions else "predicts without actions"
        if name is None:
            default = self.default(with_actions=with_actions)
            if default is None:
                raise UnavailableError(
                    f"model: found no bundle that {kind} on this server; it needs at least one."
                )
            return default
        entry = self.entry(name)
        if entry.manifest is not None and not entry.answers(with_actions=with_actions):
            others = ", ".join(e.name for e in self._of_kind(with_actions=with_actions))
            raise UnsuitableModelError(
                pointer="/model",
                found=repr(name),
                expected=f"must be one that {kind}: {others or 'none is here'}",
            )
        return entry

    def ready(self, name: str | None, *, with_actions: bool) -> tuple[Manifest, Worker]:
        """The bundle of this name, or the default one, which can answer.

        Raises:
            UnknownModelError: there is none of this name.
            UnsuitableModelError: it is for the other kind of request.
            UnavailableError: it is loading, or was refused, or there is none at all.
        """
        entry = self.chosen(name, with_actions=with_actions)
        if entry.state == "loading":
            raise UnavailableError(f"model: {entry.name} is loading; try again in a second.")
        if entry.manifest is None or entry.worker is None:
            raise _refused(entry)
        return entry.manifest, entry.worker

    def engine(self, entry: Entry) -> Engine:
        """A new engine of a bundle.

        Raises:
            UnavailableError: the bundle was refused.
            EngineError: a graph cannot be loaded.
        """
        if entry.manifest is None:
            raise _refused(entry)
        runner = Runner(entry.manifest, self._folder / entry.name, threads=self._threads)
        return Engine(runner, rows_per_step=self._rows_per_step)

    def performers(self) -> dict[str, ActionsSpec]:
        """What the bundles that perform actions know, by name, the default one first."""
        default = self.default(with_actions=True)
        ordered = sorted(self._of_kind(with_actions=True), key=lambda e: e is not default)
        return {e.name: e.manifest.actions for e in ordered if e.manifest and e.manifest.actions}

    def seconds_until_free(self) -> float:
        """When the busiest bundle will probably have answered a request."""
        workers = [entry.worker for entry in self.entries.values() if entry.worker is not None]
        return max((worker.seconds_until_free() for worker in workers), default=0.0)

    def stop(self) -> None:
        """Stop every worker; what they had not finished fails."""
        for entry in self.entries.values():
            if entry.worker is not None:
                entry.worker.stop()

    def _of_kind(self, *, with_actions: bool) -> list[Entry]:
        """The bundles for requests with or without actions that were not refused."""
        return [
            entry
            for entry in self.entries.values()
            if entry.answers(with_actions=with_actions) and entry.state != "refused"
        ]

    def _load(self, entry: Entry) -> None:
        engine = self.engine(entry)
        entry.golden_digest = warm_up(engine)
        entry.worker = self._worker(engine)
        entry.state = "ready"


@contextmanager
def _refused_on_error(entry: Entry) -> Iterator[None]:
    try:
        yield
    except (BundleError, EngineError, ValueError) as error:
        entry.reason, entry.state = str(error), "refused"
    except OSError as error:  # its text holds the whole path, which is nobody's business
        entry.reason = f"{entry.name}: a file cannot be read: {error.strerror}."
        entry.state = "refused"
    except Exception:  # noqa: BLE001 - the loader's outermost loop: the other bundles must load
        _log.exception("bundle %s could not be loaded", entry.name)
        entry.reason, entry.state = f"{entry.name}: an unforeseen error.", "refused"


def _refused(entry: Entry) -> UnavailableError:
    return UnavailableError(f"model: the bundle {entry.name} was refused: {entry.reason}")


def bundle_names(folder: Path) -> list[str]:
    """The folders that are bundles, or should be, by name."""
    if not folder.is_dir():
        return []
    return sorted(p.name for p in folder.iterdir() if p.is_dir() and p.name[0] not in "._")


def read_bundle(folder: Path) -> tuple[Manifest, str]:
    """The manifest of a bundle, and its model card.

    Raises:
        BundleError: the bundle is damaged, or its name is not its folder's.
    """
    manifest = read_manifest(folder)
    if manifest.name != folder.name:
        raise ManifestError(
            f"{folder.name}/manifest.json: name: found {manifest.name!r}; it must be the folder's."
        )
    card = folder / CARD_FILE
    text = card.read_text(encoding="utf-8", errors="replace") if card.is_file() else ""
    return manifest, text


def warm_up(engine: Engine) -> str:
    """Run every graph, and return the sha256 of the golden request's futures.

    It is a body that stands still and, where it can, performs the first action; it runs alone, and
    among other requests.

    Raises:
        EngineError: a graph does not run, gives NaN, or other bytes among other requests.
    """
    manifest = engine.manifest
    generator = np.random.Generator(np.random.Philox(key=[0, 0]))

    def standing(num_samples: int) -> Request:
        pose = generator.uniform(0.0, 1.0, (1, len(manifest.skeleton.joints), 3))
        return Request(
            observation=pose.astype(np.float32).repeat(manifest.num_observed, axis=0),
            num_samples=num_samples,
            actions=(0,) if manifest.actions else (),
        )

    golden, *strangers = (standing(num_samples) for num_samples in (GOLDEN_SAMPLES, 1, 7))
    digest = _digest(predict(engine, golden))
    *_, among = engine.run([*strangers, golden])
    if _digest(among) != digest:
        raise EngineError(
            f"{manifest.name}: the golden request gave other futures among other requests; "
            "a row must not depend on its batch."
        )
    return digest


def _digest(result: Result) -> str:
    return sha256(result.futures.tobytes()).hexdigest()


def _preferred(folder: Path, names: list[str]) -> list[str]:
    """The names in the file DEFAULT, one a line, or else the first bundle of all."""
    file = folder / DEFAULT_FILE
    lines = file.read_text(encoding="utf-8").split() if file.is_file() else []
    return lines or names[:1]
