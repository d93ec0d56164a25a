"""What the server is told by its environment; nothing else reads it."""

from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict

import models


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
    threads: int = Field(default=2, ge=1, description="cores that one bundle computes on")
    max_samples: int = Field(default=200, ge=1)
    max_frames: int = Field(default=3000, ge=1)
    max_poses: int = Field(
        default=240_000, ge=1, description="of all futures of actions in one answer"
    )
    max_body_bytes: int = Field(default=16 * 2**20, ge=1)
