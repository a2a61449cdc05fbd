"""The components of loop closure and their options."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.base.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.base.pose_graph.options import PoseGraphOptions
from toolkit.base.pose_graph.retraction import PoseGraphOptimiser
from toolkit.slam.loops.closing.object_loops import ObjectHypotheses
from toolkit.slam.loops.closing.pair_matching import PairMatcher
from toolkit.slam.loops.registration.result import Registrar
from toolkit.slam.loops.relocalisation import Relocaliser
from toolkit.slam.loops.verification import VerificationLimits


@dataclass(frozen=True)
class ClosingParts:
    """Components of loop closure.

    Attributes:
        registrar: registers submaps.
        nearby: registers submaps whose relative pose is approximately known.
        matcher: verifies pairs of keyframes from their images.
        relocaliser: relocalises lost frames.
        verification: limits that registrations must keep, and their images confirm, to become
            loops; None if loops are not tested (G).
        pose_graph: conditions that a loop edge must satisfy.
        noise: noise of odometry edges.
        loop_noise: noise of loop edges.
        optimiser: optimises pose graphs.
        objects: compares the objects of submaps; None if they are not compared.
    """

    registrar: Registrar
    nearby: Registrar
    matcher: PairMatcher
    relocaliser: Relocaliser
    verification: VerificationLimits | None
    pose_graph: PoseGraphOptions
    noise: OdometryNoise
    loop_noise: LoopNoise
    optimiser: PoseGraphOptimiser
    objects: ObjectHypotheses | None = None
