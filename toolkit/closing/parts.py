"""What loop closure is made of, and its options."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.alignment.matching import MatchingOptions
from toolkit.loops.relocalisation import Relocaliser
from toolkit.loops.verification import VerificationOptions
from toolkit.pose_graph.consistency import ConsistencyOptions
from toolkit.pose_graph.noise import LoopNoise, OdometryNoise
from toolkit.pose_graph.retraction import PoseGraphOptimiser
from toolkit.registration.result import Registrar


@dataclass(frozen=True)
class ClosingOptions:
    """Which loops are closed, and how an edge is weighed.

    Attributes:
        within, between: loops inside submaps and between them.
        min_visible: share of the second image of a pair that the first must explain.
        min_shared: share of what a suspected keyframe observed that the other one must see,
            once their submaps are registered.
        max_partners: in the end a submap is registered with so many others that it overlaps
            most, besides those a loop joins it to. Of many small ones in a room every pair
            overlaps, and measuring all would take longer than the walk.
        drift_confidence: the keyframes of a submap stay where they are unless its loops
            contradict them with so much confidence, and neighbours that were not registered
            before stay as odometry has them. A pair of images is no better than a
            centimetre; a map that was tracked well is, and would be disturbed for nothing.
        mapping_iterations: mapping iterations for each keyframe that a correction inside a submap
            has moved, at fixed poses (G: 10).
    """

    within: bool = True
    between: bool = True
    min_visible: float = 0.4
    min_shared: float = 0.3
    max_partners: int = 8
    drift_confidence: float = 0.99
    mapping_iterations: int = 0


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
