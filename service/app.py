"""The application: settings in, an ASGI app out."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from threading import Thread

from fastapi import FastAPI

from service.catalog import Catalog
from service.problems import add_problem_responses
from service.routes import router
from service.settings import Settings


def create_app(settings: Settings | None = None) -> FastAPI:
    """The service; without settings it reads those of the environment.

    Bundles load in a thread of their own, so that the server answers /livez from the start.
    """
    settings = settings or Settings()
    catalog = Catalog(
        settings.bundles, default_model=settings.default_model, threads=settings.threads
    )

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[None]:
        loader = Thread(target=catalog.load, name="load-bundles", daemon=True)
        loader.start()
        yield
        loader.join()
        catalog.stop()

    app = FastAPI(
        title="posefutures",
        summary="N plausible futures of a person's 3D motion",
        version="0.1.0",
        lifespan=lifespan,
    )
    app.state.settings = settings
    app.state.catalog = catalog
    app.state.max_body_bytes = settings.max_body_bytes
    app.include_router(router)
    add_problem_responses(app)
    return app
