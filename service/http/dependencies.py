"""What the paths of the service ask of the application and of the request."""

from typing import Annotated

from fastapi import Depends, Request

from service.catalog import Catalog
from service.http.metrics import Metrics
from service.http.visits import Visit
from service.settings import Settings


def settings_of(request: Request) -> Settings:
    """What the application was told."""
    settings: Settings = request.app.state.settings
    return settings


def metrics_of(request: Request) -> Metrics:
    """What the application counts."""
    metrics: Metrics = request.app.state.metrics
    return metrics


def visit_of(request: Request) -> Visit:
    """The visit that the request is."""
    visit: Visit = request.state.visit
    return visit


# As coroutines: FastAPI runs a plain function in another thread, which costs more than all it does.


async def _catalog(request: Request) -> Catalog:
    catalog: Catalog = request.app.state.catalog
    return catalog


async def _settings(request: Request) -> Settings:
    return settings_of(request)


async def _metrics(request: Request) -> Metrics:
    return metrics_of(request)


TheCatalog = Annotated[Catalog, Depends(_catalog)]
TheSettings = Annotated[Settings, Depends(_settings)]
TheMetrics = Annotated[Metrics, Depends(_metrics)]
