"""Settings of the trackers."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class HealthSettings(Settings):
    """Bounds beyond which a frame counts as lost."""

    least_measured: int = Field(200, ge=1, description="fewest pixels with depth")
    least_visible: float = Field(0.15, ge=0, le=1, description="least share the map explains")
    most_intensity: float = Field(0.15, gt=0, description="largest photometric scale, [0, 1]")
    most_depth_m: float = Field(0.04, gt=0, description="largest geometric scale at 1 m, m")
    least_information: float = Field(1e4, ge=0, description="smallest eigenvalue, 1 / m^2")
    most_misfit: float = Field(4.0, gt=0, description="residuals against the last frame's")


class DenseSettings(Settings):
    """Dense Gauss-Newton against the rendered map."""

    levels: int = Field(4, ge=1, le=7, description="pyramid levels")
    iterations: int = Field(12, ge=1, description="most steps a level")
    renders: int = Field(3, ge=1, description="most views drawn a frame")
    rerender_distance: float = Field(0.02, gt=0, description="motion that asks for a new view")
    least_silhouette: float = Field(0.9, gt=0, lt=1, description="thinner pixels are ignored")
    max_distance: float = Field(0.05, gt=0, description="depth gate, share of the depth")
    exposure: bool = Field(True, description="estimate gain and bias of every frame")
    photometric_weight: float = Field(1.0, gt=0, description="against the geometric term")
    start: Literal["velocity", "auto", "both"] = Field(
        "auto", description="from Open3D's odometry too: never, where a frame fits badly, always"
    )


class FirstOrderSettings(Settings):
    """Baseline, the papers' tracker: Adam on the pose."""

    preset: Literal["hier-slam", "gausem"] = Field("hier-slam", description="loss weights, H or G")
    iterations: int = Field(40, ge=1, description="Adam steps a frame")
    translation_rate: float = Field(0.002, gt=0, description="learning rate, m")
    rotation_rate: float = Field(0.001, gt=0, description="learning rate, rad")
    semantic: float | None = Field(
        None, ge=0, description="weight of the semantic term; unset: hier-slam 0, gausem 0.5"
    )


class TrackingSettings(Settings):
    """Which tracker, and its values."""

    kind: Literal["dense", "first-order"] = Field(
        "dense", description="tracker: ours, or the papers' baseline (first-order)"
    )
    dense: DenseSettings = DenseSettings()
    first_order: FirstOrderSettings = FirstOrderSettings()
    health: HealthSettings = HealthSettings()
