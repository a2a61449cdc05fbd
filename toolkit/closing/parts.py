"""What loop closure is made of, and its options."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.alignment.options import MatchingOptions
from toolkit.loops.options import VerificationOptions
from toolkit.loops.relocalisation import Relocaliser
from toolkit.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.pose_graph.options import ConsistencyOptions
from toolkit.pose_graph.retraction import PoseGraphOptimiser
from toolkit.registration.result import Registrar


@dataclass(frozen=True)
class ClosingParts:
    """What closes loops.

    Attributes:
        registrar: of submaps. nearby: of submaps that nearly fit, from a start alone.
        matching: of pairs of keyframes. relocaliser: of lost frames.
        verification, consistency: what must hold before an edge enters the graph.
        noise: of odometry. loop_noise: of loop edges.
        optimiser: of pose graphs.
    """

    registrar: Registrar
    nearby: Registrar
    matching: MatchingOptions
    relocaliser: Relocaliser
    verification: VerificationOptions
    consistency: ConsistencyOptions
    noise: OdometryNoise
    loop_noise: LoopNoise
    optimiser: PoseGraphOptimiser
