"""Options of pose graphs: noise of edges, consistency of loops, the solver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from toolkit.options import NonNegativeFloat, PositiveFloat, PositiveInt, Range

Kernel = Literal["none", "huber", "cauchy", "geman-mcclure"]
Confidence = Annotated[float, Range(gt=0, le=1)]


@dataclass(frozen=True)
class LoopNoiseOptions:
    """Noise of loop edges."""

    # The squared errors of image pairs in synthetic rooms are 2 to 4 times the expected ones.
    scale: Annotated[float, Range(ge=1)] = 4.0
    """Factor applied to the variance that an alignment reports."""
    edge_m: PositiveFloat = 0.01
    """Minimum standard deviation of an edge's translation, in metres."""
    edge_rad: PositiveFloat = 0.005
    """Minimum standard deviation of an edge's rotation, in radians."""
    unseen: PositiveFloat = 1.0
    """Standard deviation of directions without information, in metres and radians."""


@dataclass(frozen=True)
class OdometryNoiseOptions(LoopNoiseOptions):
    """Noise of odometry edges. Its variance grows linearly with the path."""

    # Set on one hand-held sequence, TUM's fr1_rpy: over 5 to 40 frames the errors of the dense
    # tracker (those of the ground truth included) are 0.7 to 1.2 of what the terms of edge and path
    # state without the information. They are conservative on rendered sequences.

    scale: Annotated[float, Range(ge=1)] = 100.0
    """Factor applied to the variance that tracking reports."""
    edge_m: PositiveFloat = 0.002
    """Minimum standard deviation of an edge's translation, in metres."""
    edge_rad: PositiveFloat = 0.001
    """Minimum standard deviation of an edge's rotation, in radians."""
    per_metre_m: NonNegativeFloat = 0.015
    """Standard deviation of the translation after a path of 1 m, in metres."""
    per_metre_rad: NonNegativeFloat = 0.01
    """Standard deviation of the rotation after a path of 1 m, in radians."""
    per_radian_m: NonNegativeFloat = 0.015
    """Standard deviation of the translation after a rotation by 1 rad, in metres."""
    per_radian_rad: NonNegativeFloat = 0.02
    """Standard deviation of the rotation after a rotation by 1 rad, in radians."""
    # Set by `python -m benchmarks.uncertainty` on all recordings at every first, fourth and eighth
    # frame.
    drift: NonNegativeFloat = 0.5
    """Standard deviation of a frame's drift over 1 m or 1 rad of motion between views of the same
    surfaces, relative to that which one pixel's residuals determine."""
    frame: NonNegativeFloat = 0.5
    """Standard deviation of a frame against the map, relative to that which one pixel's residuals
    determine, while the camera hardly moves."""
    moved: PositiveFloat = 0.05
    """Motion between two frames that doubles the variance of a frame against the map, in metres
    plus radians."""
    near_m: PositiveFloat = 0.5
    """Maximum distance of two views of the same surfaces, in metres."""
    near_rad: PositiveFloat = 0.5
    """Maximum angle between two views of the same surfaces, in radians."""


@dataclass(frozen=True)
class ConsistencyOptions:
    """Pairwise consistency of loops."""

    odometry_confidence: Confidence = 0.999
    """Fraction of correct loops that pass the test against the odometry."""
    pair_confidence: Confidence = 0.999
    """Fraction of pairs of correct loops that pass the test against each other."""
    exact_up_to: PositiveInt = 40
    """Maximum number of loops for which the largest consistent set is found exactly. Larger sets
    are searched greedily."""


@dataclass(frozen=True)
class SolverOptions:
    """The Levenberg-Marquardt solver of pose graphs."""

    kernel: Kernel = "cauchy"
    """Robust kernel of loop edges."""
    # A correct edge of 6 degrees of freedom has 2.4 on average.
    kernel_width: PositiveFloat = 3.0
    """Width of the robust kernel, in standard deviations."""
    initialise: bool = False
    """Start from the chordal initialisation instead of the current poses."""
    iterations: PositiveInt = 100
    """Maximum number of iterations."""
    tolerance: PositiveFloat = 1e-9
    """Relative and absolute decrease of the error below which the solver stops."""


@dataclass(frozen=True)
class RetractionOptions:
    """Removal of loops that contradict the optimised graph."""

    confidence: Confidence = 0.999
    """Fraction of correct loops that each test keeps."""


@dataclass(frozen=True)
class PoseGraphOptions:
    """Pose graphs of submaps and of keyframes."""

    odometry: OdometryNoiseOptions = OdometryNoiseOptions()
    loops: LoopNoiseOptions = LoopNoiseOptions()
    consistency: ConsistencyOptions = ConsistencyOptions()
    solver: SolverOptions = SolverOptions()
    retraction: RetractionOptions = RetractionOptions()
