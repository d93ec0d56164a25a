"""What the paths of the service ask of the application and of the request."""

from typing import Annotated

from fastapi import Depends, Request

from service.catalog import Catalog
from service.metrics import Metrics
from service.settings import Settings
from service.visits import Visit


def catalog_of(request: Request) -> Catalog:
    """The bundles of the application."""
    catalog: Catalog = request.app.state.catalog
    return catalog


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


TheCatalog = Annotated[Catalog, Depends(catalog_of)]
TheSettings = Annotated[Settings, Depends(settings_of)]
TheMetrics = Annotated[Metrics, Depends(metrics_of)]
