import json
import os
import shutil
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from threading import Event

import pytest
from in_memory import Service
from tiny_bundles import (
    FUTURE,
    HORIZON,
    OBSERVATION,
    LastPose,
    exported,
    walking,
    write,
    write_diffusion_bundle,
)

from models.bundle import read_manifest
from service.app import create_app
from service.catalog import Catalog
from service.engine.engine import Engine
from service.errors import UnknownModelError
from service.settings import Settings
from service.worker import EXPRESS, WRITERS, Worker

CORES = len(os.sched_getaffinity(0))
BODY = {"poses": walking(), "num_samples": 1}


@pytest.fixture
def copies(bundles: Path, tmp_path: Path) -> Path:
    return shutil.copytree(bundles, tmp_path / "copies")


def flip_bit(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_flipped_bit_refuses_its_bundle_and_no_other(
    copies: Path, caplog: pytest.LogCaptureFixture
):
    flip_bit(copies / "still" / "decoder.onnx")
    with Service.of(copies) as service:
        service.wait_until_loaded()
        assert service.post(BODY).status_code == 200
        refused = service.post({**BODY, "model": "still"})
        assert refused.status_code == 503
        assert refused.json()["type"] == "/problems/unavailable"
        assert "still/decoder.onnx: found sha256" in refused.json()["detail"]
        assert str(copies) not in refused.text
        ready = service.get("/readyz")
        assert ready.status_code == 200
        assert ready.json()["models"]["still"].startswith("refused: still/decoder.onnx")
        assert service.get("/models/still").json()["state"] == "refused"
    assert "bundle still is refused: still/decoder.onnx" in caplog.text


def break_manifest(folder: Path) -> None:
    (folder / "manifest.json").write_text("{")


def remove_manifest(folder: Path) -> None:
    (folder / "manifest.json").unlink()


def remove_graph(folder: Path) -> None:
    (folder / "decoder.onnx").unlink()


def rename(folder: Path) -> None:
    manifest = folder / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"still"', '"stiller"'))


def swap_schedule(folder: Path) -> None:
    shutil.rmtree(folder)
    shutil.copytree(folder.parent / "diffusion", folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    manifest["name"] = "still"
    manifest["schedule"]["alpha_bar"].reverse()
    (folder / "manifest.json").write_text(json.dumps(manifest))


def make_manifest_a_folder(folder: Path) -> None:
    (folder / "manifest.json").unlink()
    (folder / "manifest.json").mkdir()


def answer_nan(folder: Path) -> None:
    class Nan(LastPose):
        def forward(self, observation):
            return super().forward(observation) * (observation[:, :1, :1] * 0.0).log().log()

    graph = exported(Nan(), "decoder.onnx", inputs=(OBSERVATION,), outputs=(FUTURE,))
    write(folder, {"decoder": graph})


def lean_on_strangers(folder: Path) -> None:
    class Mean(LastPose):
        def forward(self, observation):
            return super().forward(observation) + observation.mean()

    graph = exported(Mean(), "decoder.onnx", inputs=(OBSERVATION,), outputs=(FUTURE,))
    write(folder, {"decoder": graph})


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (break_manifest, "still/manifest.json"),
        (remove_manifest, "still: found no manifest.json"),
        (remove_graph, "still/decoder.onnx: the file is missing"),
        (swap_schedule, "alpha_bar: must fall"),
        (make_manifest_a_folder, "still: found no manifest.json"),
        (rename, "name: found 'stiller'"),
        (answer_nan, "still: the decoder gave NaN"),
        (lean_on_strangers, "still: the golden request gave other futures among other requests"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_damaged_bundle_is_refused_with_its_reason(copies: Path, damage, reason: str):
    damage(copies / "still")
    catalog = Catalog(copies, default_model=None, threads=1)
    catalog.load()
    catalog.stop()
    assert catalog.entries["diffusion"].state == "ready"
    assert catalog.entries["still"].state == "refused"
    assert reason in (catalog.entries["still"].reason or "")


def test_unforeseen_error_refuses_its_bundle_and_no_other(
    copies: Path, caplog: pytest.LogCaptureFixture
):
    def breaks_once(engine: Engine) -> Worker:
        if engine.manifest.name == "diffusion":
            raise ZeroDivisionError
        return Worker(engine, max_rows=99)

    catalog = Catalog(copies, default_model=None, worker=breaks_once)
    catalog.load()
    catalog.stop()
    assert catalog.entries["diffusion"].state == "refused"
    assert catalog.entries["diffusion"].reason == "diffusion: an unforeseen error."
    assert "ZeroDivisionError" in caplog.text
    assert catalog.entries["still"].state == "ready"


def test_golden_digest_is_that_of_the_same_bytes_for_the_same_bundle(copies: Path):
    shutil.copytree(copies / "diffusion", copies / "other")
    manifest = copies / "other" / "manifest.json"
    manifest.write_text(manifest.read_text().replace('"name":"diffusion"', '"name":"other"'))
    manifest.write_text(manifest.read_text().replace('"name": "diffusion"', '"name": "other"'))
    write_diffusion_bundle(copies / "stochastic", eta=1.0)
    catalogs = [Catalog(copies, default_model=None, rows_per_step=rows) for rows in (64, 3)]
    digests = []
    for catalog in catalogs:
        catalog.load()
        catalog.stop()
        digests.append({e.name: e.golden_digest for e in catalog.entries.values()})
    first, again = digests
    assert first == again
    assert first["diffusion"] == first["other"]
    assert len({first["diffusion"], first["stochastic"], first["still"]}) == 3


def test_default_is_the_setting_or_the_file_or_the_first(copies: Path):
    def default(name: str | None = None) -> str | None:
        return Catalog(copies, default_model=name, threads=1).default_model

    assert default("still") == "still"
    (copies / "DEFAULT").write_text("still\n")
    assert default() == "still"
    (copies / "DEFAULT").unlink()
    assert default() == "diffusion"
    with pytest.raises(UnknownModelError, match="must be one of diffusion, still"):
        default("oracle")


@pytest.mark.parametrize("folder", ["empty", "missing"])
def test_server_without_bundles_is_alive_and_not_ready(tmp_path: Path, folder: str):
    (tmp_path / "empty").mkdir()
    with Service.of(tmp_path / folder) as service:
        assert service.get("/livez").status_code == 200
        assert service.get("/readyz").status_code == 503
        response = service.post(BODY)
        assert response.status_code == 503
        assert "no bundle" in response.json()["detail"]


@pytest.mark.skipif(sys.platform != "linux", reason="threads have no priority of their own")
def test_threads_that_compute_leave_the_cores_to_the_event_loop(bundles: Path):
    before = set(threading.enumerate())
    with Service.of(bundles, workers=2, niceness=3) as service:
        service.wait_until_loaded()
        others = set(threading.enumerate()) - before
        computing = [thread for thread in others if thread.name.startswith("engine-")]
        priorities = {os.getpriority(os.PRIO_PROCESS, t.native_id or 0) for t in computing}
        own = os.getpriority(os.PRIO_PROCESS, threading.get_native_id())
    assert len(computing) == 2 * (2 + WRITERS + EXPRESS)
    assert priorities == {own + 3}


def test_only_loading_makes_a_server_unready(bundles: Path, monkeypatch: pytest.MonkeyPatch):
    may_load = Event()
    load = Catalog.load

    def held(catalog: Catalog, *warm_up: Callable[[], object]) -> None:
        may_load.wait()
        load(catalog, *warm_up)

    monkeypatch.setattr(Catalog, "load", held)
    with Service.of(bundles) as service:
        assert service.get("/livez").status_code == 200
        ready = service.get("/readyz")
        assert (ready.status_code, ready.json()["status"]) == (503, "loading")
        early = service.post(BODY)
        assert (early.status_code, early.json()["type"]) == (503, "/problems/unavailable")
        assert early.headers["retry-after"] == "1"
        may_load.set()
        service.wait_until_loaded()
        assert service.get("/readyz").status_code == 200
        assert service.post(BODY).status_code == 200


def test_who_waits_for_a_server_is_told_once_that_it_is_ready(bundles: Path):
    told: list[float] = []
    settings = Settings(bundles=bundles, threads=1)
    app = create_app(settings, once_ready=lambda: told.append(1.0))
    with Service(app) as service:
        assert told == []
        service.wait_until_loaded()
        assert service.post(BODY).status_code == 200
        assert told == [1.0]


def test_settings_come_from_the_environment(bundles: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("POSEFUTURES_BUNDLES", str(bundles))
    monkeypatch.setenv("POSEFUTURES_DEFAULT_MODEL", "still")
    monkeypatch.setenv("POSEFUTURES_MAX_SAMPLES", "7")
    app = create_app()
    assert app.state.catalog.default_model == "still"
    assert app.state.settings.max_samples == 7
    monkeypatch.delenv("POSEFUTURES_BUNDLES")
    assert Settings().bundles.name == "bundles"


@pytest.mark.parametrize(
    ("given", "workers", "threads"),
    [
        ({}, CORES, 1),
        ({"profile": "latency"}, 1, CORES),
        ({"workers": 5}, 5, 1),
        ({"profile": "latency", "workers": 3, "threads": 7}, 3, 7),
    ],
)
def test_profile_decides_who_computes_on_the_cores(given, workers: int, threads: int):
    settings = Settings(**given)
    assert (settings.num_workers, settings.num_threads) == (workers, threads)


def test_bundle_of_a_test_has_the_horizon_it_says(bundles: Path):
    assert read_manifest(bundles / "still").horizon == HORIZON
