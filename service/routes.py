"""The paths that tell of the service: what it can do, what it takes, and how it is."""

from dataclasses import asdict
from itertools import chain

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client import CONTENT_TYPE_LATEST

from models.motion.standards import STANDARDS
from service import schemas
from service.catalog import Entry
from service.errors import NotFoundError, UnauthorisedError, UnknownModelError
from service.http.body import BodyRoute
from service.http.dependencies import TheCatalog, TheMetrics, TheSettings
from service.http.problems import declared, problem

router = APIRouter(route_class=BodyRoute, responses=declared(UnauthorisedError))
health = APIRouter()


@router.get("/actions")
async def actions(catalog: TheCatalog) -> schemas.Actions:
    """The actions that can be asked for, those of the default model first."""
    default = catalog.default(with_actions=True)
    performers = catalog.performers()
    listed = [
        schemas.Action(
            label=label,
            example=next(
                (spec.examples[label] for spec in performers.values() if label in spec.examples),
                None,
            ),
            models=[name for name, spec in performers.items() if label in spec.labels],
        )
        for label in dict.fromkeys(chain(*(spec.labels for spec in performers.values())))
    ]
    return schemas.Actions(default_model=default.name if default else None, actions=listed)


@router.get("/models")
async def models(catalog: TheCatalog) -> schemas.Models:
    """The bundles of this server, and which of them answers when a request names none."""
    summaries = [
        schemas.ModelSummary.model_validate(_summary(entry)) for entry in catalog.entries.values()
    ]
    return schemas.Models(default=catalog.default_model, models=summaries)


@router.get("/models/{name}", response_model=schemas.ModelDetail, responses=declared(NotFoundError))
async def model(name: str, catalog: TheCatalog) -> schemas.ModelDetail | Response:
    """One bundle: its manifest in short, its digest and its model card."""
    try:
        entry = catalog.entry(name)
    except UnknownModelError as error:
        return problem(error, status=404)
    manifest = entry.manifest
    detail = _summary(entry) | {
        "card": entry.card,
        "recipe": manifest.recipe if manifest else {},
        "training": manifest.training if manifest else {},
    }
    return schemas.ModelDetail.model_validate(detail)


@router.get("/skeletons")
async def skeletons() -> schemas.Skeletons:
    """The skeletons that a request may name."""
    return schemas.Skeletons(
        skeletons=[
            schemas.StandardSkeleton(
                name=name,
                joints=list(standard.joints),
                parents=list(standard.parents),
                axes=schemas.AxesBody(**asdict(standard.axes)),
            )
            for name, standard in STANDARDS.items()
        ]
    )


@router.get("/limits")
async def limits(settings: TheSettings) -> schemas.Limits:
    """What this server takes at most."""
    values = settings.model_dump(include=set(schemas.Limits.model_fields))
    return schemas.Limits(max_actions=schemas.MAX_ACTIONS, **values)


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}},
)
async def metrics(request: Request, catalog: TheCatalog, metrics: TheMetrics) -> Response:
    """What Prometheus collects."""
    text = metrics.text(catalog, draining=request.app.state.draining)
    return Response(text, headers={"Content-Type": CONTENT_TYPE_LATEST})


@health.get("/livez")
async def livez() -> schemas.Live:
    """The process answers."""
    return schemas.Live()


@health.get("/readyz", response_model=schemas.Ready, responses={503: {"model": schemas.Ready}})
async def readyz(request: Request, catalog: TheCatalog) -> Response:
    """200 while predictions are answered: each bundle warmed up, and the server not ending."""
    states = {
        name: f"{entry.state}: {entry.reason}" if entry.reason else entry.state
        for name, entry in catalog.entries.items()
    }
    ready = schemas.Ready(
        status="draining" if request.app.state.draining else catalog.state,
        default_model=catalog.default_model,
        models=states,
        golden_digests={
            name: entry.golden_digest
            for name, entry in catalog.entries.items()
            if entry.golden_digest is not None
        },
    )
    return JSONResponse(ready.model_dump(), status_code=200 if ready.status == "ready" else 503)


def _summary(entry: Entry) -> dict[str, object]:
    summary: dict[str, object] = {"name": entry.name, "state": entry.state, "reason": entry.reason}
    manifest = entry.manifest
    if manifest is not None:
        summary |= {
            "version": manifest.version,
            "digest": manifest.digest,
            "description": manifest.description,
            "licence": manifest.licence,
            "attribution": list(manifest.attribution),
            "skeleton": manifest.skeleton.name,
            "joints": list(manifest.skeleton.joints),
            "fps": manifest.fps,
            "num_observed": manifest.num_observed,
            "horizon": manifest.horizon,
            "num_steps": manifest.num_steps,
            "default_steps": manifest.default_steps,
            "step_plan": manifest.schedule.plan if manifest.schedule else None,
            "trajectory": manifest.trajectory,
            "actions": list(manifest.actions.labels) if manifest.actions else [],
        }
    return summary
