"""Options of the service."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from toolkit.base.options import PositiveInt, Range


@dataclass(frozen=True)
class ServiceLimits:
    """Limits of the service."""

    max_pixels: Annotated[int, Range(ge=64, le=33_554_432)] = 2_073_600
    """Maximum number of pixels of a rendered image; by default that of 1920x1080."""
    max_body_bytes: Annotated[int, Range(ge=256, le=1_048_576)] = 16_384
    """Maximum size of the body of a request, in bytes."""
    max_waiting: PositiveInt = 32
    """Maximum number of renders and queries that are computed or wait; they are computed one after
    another. Further ones are answered with status 503."""
    max_connections: PositiveInt = 128
    """Maximum number of open connections of all clients. A further one ends that which has waited
    longest for its client, and is answered with status 503 if none waits."""


@dataclass(frozen=True)
class EarlierRun:
    """The earlier run of the same place with which --mcp compares the objects of the run."""

    earlier: Path | None = None
    """Folder of the earlier run."""
    registration: Path | None = None
    """The register.json of `semsplat register` for both runs, which aligns them. By default, the
    maps are registered when an assistant asks for changes."""
    same_frame: bool = False
    """The maps have the same frame, as maps of given poses do; they are not registered."""
