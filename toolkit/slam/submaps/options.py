"""Options of submaps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.base.options import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Range,
)


@dataclass(frozen=True)
class AllocationOptions:
    """When a new submap is started."""

    rule: Literal["places", "motion"] = "places"
    """Criterion for a new submap: less than half of the view is inside the submap's volume and its
    classes change (places), or the camera's distance from the anchor (motion)."""
    min_divergence: NonNegativeFloat | None = None
    """Minimum KL divergence of the classes in view from the anchor's, in nats. Above it, the view
    is semantically new. By default, 0.4, or 0.05 for geometric labels."""
    # The preceding view always overlaps with the newest one. If it were included, the criterion
    # would never be met.
    recent: NonNegativeInt = 10
    """Number of newest keyframes excluded from the submap's volume."""
    # While the camera explores, every view is new. A minimum size avoids tiny submaps.
    min_keyframes: Annotated[int, Range(ge=2)] = 60
    """Minimum number of keyframes of a submap."""
    enough_keyframes: Annotated[int, Range(ge=2)] = 150
    """Number of keyframes from which a submap only gets views of surfaces that it does not show,
    and ends at the first view that leaves its volume."""
    max_keyframes: Annotated[int, Range(ge=2)] = 300
    """Maximum number of keyframes of a submap."""
    max_gaussians: PositiveInt = 1_000_000
    """Maximum number of Gaussians of a submap."""
    max_path_m: PositiveFloat = 30.0
    """Maximum path length of the camera in a submap, in metres."""


@dataclass(frozen=True)
class BoundaryOptions:
    """The transition from one submap to the next."""

    bundle_adjustment: bool = False
    """Optimise keyframe poses around the boundary as well."""
    inherit: bool = True
    """Start a submap with copies of the old submap's Gaussians that are visible from its anchor."""


@dataclass(frozen=True)
class SubmapOptions:
    """Division of the map into submaps."""

    use: bool = True
    """Divide the map into submaps."""
    memory_mb: NonNegativeFloat = 500.0
    """Memory for inactive submaps, in MB. The remaining ones are stored on disk."""
    allocation: AllocationOptions = AllocationOptions()
    boundary: BoundaryOptions = BoundaryOptions()
