"""What the server is told by its environment; nothing else reads it."""

import os
from pathlib import Path
from typing import Annotated, Literal

from limits import parse
from pydantic import DirectoryPath, Field, SecretStr, field_validator
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

import models
from service.engine.engine import ROWS_PER_STEP


class Settings(BaseSettings):
    """Values of POSEFUTURES_* variables, such as POSEFUTURES_PORT=8001."""

    model_config = SettingsConfigDict(env_prefix="POSEFUTURES_", frozen=True)

    bundles: Path = Field(
        default=Path(models.__path__[0]) / "bundles",
        description="folder with one folder per bundle",
    )
    default_model: str | None = Field(
        default=None, description="bundle that answers when a request names none"
    )
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=1, le=65535)
    profile: Literal["throughput", "latency"] = Field(
        default="throughput",
        description="a worker for each core, or one that computes each request on all of them",
    )
    workers: int | None = Field(
        default=None, ge=1, description="threads that step a bundle; by default the profile's"
    )
    threads: int | None = Field(
        default=None, ge=1, description="cores of one graph's call; by default the profile's"
    )
    niceness: int = Field(
        default=10,
        ge=0,
        le=19,
        description="of the threads that compute: beside the event loop, so that it answers at "
        "once, and beside other programs; Linux only",
    )
    rows_per_step: int = Field(default=ROWS_PER_STEP, ge=1, description="of one worker's step")
    max_queued_requests: int = Field(default=64, ge=1, description="under way")
    max_queued_rows: int = Field(
        default=3200, ge=1, description="samples under way, for one bundle"
    )
    drain_s: float = Field(default=10.0, ge=0, description="to finish requests in when told to end")
    max_samples: int = Field(default=200, ge=1)
    max_frames: int = Field(default=3000, ge=1)
    max_poses: int = Field(default=240_000, ge=1, description="of all futures of one answer")
    max_body_bytes: int = Field(default=16 * 2**20, ge=1)
    max_horizon_s: float = Field(default=10.0, gt=0, description="rolled out beyond the bundle's")
    max_streams: int = Field(default=64, ge=0, description="open at a time")
    api_keys: Annotated[tuple[SecretStr, ...], NoDecode] = Field(
        default=(), description="keys with commas between them; without any, everybody may ask"
    )
    rate_limit: str | None = Field(
        default=None, description="of each key, else of each address, such as 60/minute"
    )
    pose_landmarker: DirectoryPath | None = Field(
        default=None,
        description="folder with MediaPipe's files, for the webcam of the page",
    )
    otel_endpoint: str | None = Field(
        default=None, validation_alias="OTEL_EXPORTER_OTLP_ENDPOINT", description="takes spans"
    )

    @field_validator("api_keys", mode="before")
    @classmethod
    def _apart(cls, keys: object) -> object:
        if not isinstance(keys, str):
            return keys
        return tuple(key.strip() for key in keys.split(",") if key.strip())

    @field_validator("rate_limit")
    @classmethod
    def _a_rate(cls, rate: str | None) -> str | None:
        if rate is not None:
            parse(rate)
        return rate

    @property
    def num_workers(self) -> int:
        """How many threads step one bundle."""
        return self.workers or (_num_cores() if self.profile == "throughput" else 1)

    @property
    def num_threads(self) -> int:
        """How many cores one call of a graph computes on."""
        return self.threads or (_num_cores() if self.profile == "latency" else 1)


def _num_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
