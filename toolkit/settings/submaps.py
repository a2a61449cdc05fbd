"""Settings of submaps."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class AllocationSettings(Settings):
    """When the next submap begins."""

    rule: Literal["places", "motion"] = Field(
        "places", description="what is seen, or the distance from the anchor"
    )
    min_overlap: float = Field(0.5, ge=0, le=1, description="of the view, spatially new below")
    min_divergence: float | None = Field(
        None, ge=0, description="KL from the anchor's classes, nats; unset, the segmenter's own"
    )
    recent: int = Field(10, ge=0, description="newest keyframes that are not the volume")
    min_keyframes: int = Field(60, ge=2, description="a smaller submap takes what comes")
    moved_m: float = Field(0.5, gt=0, description="from the anchor, by the rule of motion")
    turned_deg: float = Field(50.0, gt=0, description="from the anchor, by the rule of motion")
    max_keyframes: int = Field(150, ge=2, description="cap that acts alone")
    max_gaussians: int = Field(1_000_000, ge=1, description="cap that acts alone")
    max_path_m: float = Field(30.0, gt=0, description="cap that acts alone, m")


class BoundarySettings(Settings):
    """Where one submap ends and the next begins."""

    steps: int = Field(24, ge=0, description="optimisation around it before the old one rests")
    bundle_adjustment: bool = Field(False, description="of the keyframes' poses around it too")
    inherit: bool = Field(True, description="begin with copies of what the anchor sees")


class SubmapSettings(Settings):
    """Submaps; without `use` the map stays one."""

    use: bool = Field(True, description="cut long sequences into submaps")
    memory_mb: float = Field(500.0, ge=0, description="for resting submaps; the rest is on disk")
    allocation: AllocationSettings = AllocationSettings()
    boundary: BoundarySettings = BoundarySettings()
