"""Parts of pose graphs from settings."""

from __future__ import annotations

from toolkit.pose_graph.consistency import ConsistencyOptions
from toolkit.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.pose_graph.retraction import PoseGraphOptimiser, RetractionOptions
from toolkit.pose_graph.solver import SolverOptions
from toolkit.settings.pose_graph import PoseGraphSettings


def build_optimiser(settings: PoseGraphSettings) -> PoseGraphOptimiser:
    """What solves graphs and takes loops back."""
    return PoseGraphOptimiser(
        SolverOptions(**settings.solver.model_dump()),
        RetractionOptions(**settings.retraction.model_dump()),
    )


def build_odometry_noise(settings: PoseGraphSettings) -> OdometryNoise:
    """What a tracker's information is worth."""
    return OdometryNoise(**settings.odometry.model_dump())


def build_loop_noise(settings: PoseGraphSettings) -> LoopNoise:
    """What a registration's information is worth."""
    return LoopNoise(**settings.loops.model_dump())


def build_consistency(settings: PoseGraphSettings) -> ConsistencyOptions:
    """When loops agree."""
    return ConsistencyOptions(**settings.consistency.model_dump())
