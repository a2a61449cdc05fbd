"""Settings of pose graphs: noise of edges, agreement of loops, the solver."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from toolkit.settings.base import Settings


class LoopNoiseSettings(Settings):
    """Standard deviations of loops."""

    scale: float = Field(100.0, ge=1, description="factor on the variance that was stated")
    edge_m: float = Field(0.01, gt=0, description="least of every edge, m")
    edge_rad: float = Field(0.005, gt=0, description="least of every edge, rad")
    unseen: float = Field(1.0, gt=0, description="where nothing was seen, m and rad")


class OdometryNoiseSettings(LoopNoiseSettings):
    """Standard deviations of odometry; those along a path grow with its root."""

    edge_m: float = Field(0.002, gt=0, description="least of every edge, m")
    edge_rad: float = Field(0.001, gt=0, description="least of every edge, rad")
    per_metre_m: float = Field(0.015, ge=0, description="after a metre of path, m")
    per_metre_rad: float = Field(0.01, ge=0, description="after a metre of path, rad")
    per_radian_m: float = Field(0.015, ge=0, description="after a turn by one radian, m")
    per_radian_rad: float = Field(0.02, ge=0, description="after a turn by one radian, rad")


class ConsistencySettings(Settings):
    """Which loops may enter the graph."""

    odometry_confidence: float = Field(
        0.999, gt=0, le=1, description="share of right loops that agree with the odometry"
    )
    pair_confidence: float = Field(
        0.999, gt=0, le=1, description="share of pairs of right loops that agree"
    )
    exact_up_to: int = Field(40, ge=1, description="more loops are searched greedily")


class SolverSettings(Settings):
    """Levenberg-Marquardt."""

    kernel: Literal["none", "huber", "cauchy", "geman-mcclure"] = Field(
        "cauchy", description="robust kernel of loops"
    )
    kernel_width: float = Field(3.0, gt=0, description="of the kernel, standard deviations")
    initialise: bool = Field(False, description="start from the chordal initialisation")
    iterations: int = Field(100, ge=1, description="most steps")
    tolerance: float = Field(1e-9, gt=0, description="fall of the error that ends them")


class RetractionSettings(Settings):
    """Which loops leave the graph again."""

    confidence: float = Field(0.999, gt=0, le=1, description="share of right loops that stay")


class PoseGraphSettings(Settings):
    """Pose graphs of submaps and of keyframes."""

    odometry: OdometryNoiseSettings = OdometryNoiseSettings()
    loops: LoopNoiseSettings = LoopNoiseSettings()
    consistency: ConsistencySettings = ConsistencySettings()
    solver: SolverSettings = SolverSettings()
    retraction: RetractionSettings = RetractionSettings()
