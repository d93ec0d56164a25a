"""The application: settings in, an ASGI app out."""

import asyncio
import os
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from operator import attrgetter
from threading import Thread
from typing import Any

from fastapi import FastAPI

from service.catalog import Catalog
from service.http import files, predictions, validation
from service.http.guard import KEY_PROTOCOL, STREAM_PROTOCOL, Guard
from service.http.metrics import Metrics
from service.http.page import add_page
from service.http.problems import add_problem_responses
from service.http.telemetry import telemetry_config
from service.http.visits import Visits
from service.http.warm_up import warm_up
from service.live import stream
from service.live.sessions import Sessions
from service.routes import health, router
from service.settings import Settings
from service.worker import Worker

KEY_OF_STREAMS = (
    "In browsers, which cannot set this header for WS /stream, the WebSocket offers the protocols "
    f"`{STREAM_PROTOCOL}` and `{KEY_PROTOCOL}` before the key in base64url without padding."
)


def create_app(
    settings: Settings | None = None, *, once_ready: Callable[[], object] = lambda: None
) -> FastAPI:
    """The service; without settings it reads those of the environment.

    Bundles load in a thread of their own, so that the server answers /livez from the start; it
    calls ``once_ready`` when requests can be answered.

    Raises:
        ServiceError: it is configured for something that is not installed.
    """
    settings = settings or Settings()
    metrics = Metrics()
    catalog = Catalog(
        settings.bundles,
        default_model=settings.default_model,
        threads=settings.num_threads,
        rows_per_step=settings.rows_per_step,
        worker=partial(
            Worker,
            threads=settings.num_workers,
            max_rows=settings.max_queued_rows,
            observer=metrics,
        ),
    )

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        work = [app, catalog, asyncio.get_running_loop(), once_ready]
        loader = Thread(target=_load, args=work, name="load-bundles", daemon=True)
        loader.start()
        watch = asyncio.create_task(metrics.watch_event_loop())
        yield
        watch.cancel()
        await asyncio.to_thread(loader.join)
        await asyncio.to_thread(catalog.stop)

    app = FastAPI(
        title="posefutures",
        summary="N plausible futures of a person's 3D motion",
        version="0.1.0",
        lifespan=lifespan,
        generate_unique_id_function=attrgetter("name"),
        telemetry=telemetry_config(settings.otel_endpoint),
    )
    app.state.settings = settings
    app.state.catalog = catalog
    app.state.metrics = metrics
    app.state.draining = False
    app.state.streams = set()
    app.state.sessions = Sessions(most=settings.max_streams)
    app.include_router(predictions.router)
    app.include_router(files.router)
    app.include_router(validation.router)
    app.include_router(stream.router)
    app.include_router(router)
    app.include_router(health)
    add_page(app, pose_landmarker=settings.pose_landmarker)
    add_problem_responses(app)
    keys = [key.get_secret_value() for key in settings.api_keys]
    app.add_middleware(
        Guard,
        api_keys=keys,
        rate_limit=settings.rate_limit,
        max_requests=settings.max_queued_requests,
        seconds_until_free=catalog.seconds_until_free,
    )
    app.add_middleware(Visits, ended=metrics.visited)
    _say_limits(app, settings)
    return app


async def drain(app: FastAPI) -> None:
    """Take no more predictions, and end those under way in ``drain_s`` with what is ready then."""
    app.state.draining = True
    entries = app.state.catalog.entries.values()
    workers = [entry.worker for entry in entries if entry.worker is not None]
    await asyncio.gather(*(worker.drain(app.state.settings.drain_s) for worker in workers))


def _load(
    app: FastAPI,
    catalog: Catalog,
    loop: asyncio.AbstractEventLoop,
    once_ready: Callable[[], object],
) -> None:
    """Load every bundle in this thread, whose priority all threads that compute inherit."""

    def warmed_up() -> None:
        asyncio.run_coroutine_threadsafe(warm_up(app, catalog), loop).result()
        once_ready()

    if sys.platform == "linux":  # elsewhere the whole process has one
        nicer = os.getpriority(os.PRIO_PROCESS, 0) + app.state.settings.niceness
        os.setpriority(os.PRIO_PROCESS, 0, nicer)
    catalog.load(warmed_up)


def _say_limits(app: FastAPI, settings: Settings) -> None:
    """Let the OpenAPI document tell the limits, and the key that has to be sent."""
    generate = app.openapi

    def openapi() -> dict[str, Any]:
        if app.openapi_schema is None:
            document = generate()
            schemas = document["components"]["schemas"]
            for name in ("PredictRequest", "PredictActionsRequest"):
                fields = schemas[name]["properties"]
                fields["num_samples"]["maximum"] = settings.max_samples
                fields["poses"]["maxItems"] = settings.max_frames
            (seconds, _) = schemas["PredictRequest"]["properties"]["horizon_s"]["anyOf"]
            seconds["maximum"] = settings.max_horizon_s
            if settings.api_keys:
                document["components"]["securitySchemes"] = {
                    "key": {"type": "http", "scheme": "bearer", "description": KEY_OF_STREAMS}
                }
                document["security"] = [{"key": []}]
        return app.openapi_schema or {}

    app.openapi = openapi  # type: ignore[method-assign]  # as FastAPI's documents tell to
