"""What a solved pose graph moves: anchors of submaps, or keyframes with their Gaussians.

G prints one update for both, inverse(T_new) T_old in front of every pose of a submap. With
poses in the submap's own frame nothing inside has to move when an anchor does, and within a
submap a Gaussian follows the keyframe that measured it, by T_new inverse(T_old).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.graph import PoseEdge, PoseGraph
from toolkit.pose_graph.solver import PoseGraphSolution
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseCorrection:
    """New poses of a graph's nodes beside those they had.

    Attributes:
        T_old, T_new: [4, 4] float64 by node: a submap's number (T_world_submap), or a
            keyframe's frame index (T_submap_camera).
        covariances: [6, 6] of x in T_new exp(x), by node; empty where not computed.
    """

    T_old: Mapping[int, Array] = field(repr=False)
    T_new: Mapping[int, Array] = field(repr=False)
    covariances: Mapping[int, Array] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if self.T_old.keys() != self.T_new.keys():
            raise ValueError("a correction needs the old and the new pose of the same nodes")

    @classmethod
    def of(cls, graph: PoseGraph, solution: PoseGraphSolution) -> PoseCorrection:
        """From the graph's own poses to the solution's."""
        covariances: dict[int, Array] = {}
        if solution.covariances is not None:
            covariances = dict(zip(graph.nodes, solution.covariances, strict=True))
        return cls(dict(graph.T_world_node), dict(solution.T_world_node), covariances)

    @property
    def moved(self) -> list[int]:
        """Nodes whose pose differs in any bit, ascending."""
        return sorted(n for n, T in self.T_new.items() if not np.array_equal(T, self.T_old[n]))

    def motion(self, node: int) -> Array:
        """[4, 4] T_new inverse(T_old): what moves along with the node moves by this."""
        return self.T_new[node] @ se3.inverse(self.T_old[node])

    @property
    def largest_m(self) -> float:
        """How far the origin of the node that moves farthest moves, metres."""
        steps = [self.T_new[n][:3, 3] - T[:3, 3] for n, T in self.T_old.items()]
        return max((float(np.linalg.norm(step)) for step in steps), default=0.0)

    @property
    def largest_rad(self) -> float:
        """How far the node that turns most turns, radians."""
        turns = [T[:3, :3].T @ self.T_new[n][:3, :3] for n, T in self.T_old.items()]
        return max((float(se3.rotation_angle_rad(R)) for R in turns), default=0.0)


def submap_graph(
    T_world_submap: Mapping[int, Array],
    odometry: Iterable[PoseEdge],
    registrations: Iterable[PoseEdge],
) -> PoseGraph:
    """The graph between submaps, with the first one's anchor fixed.

    Args:
        T_world_submap: [4, 4] of each submap, by number.
        odometry: edges between neighbouring anchors, as measured when the
            submap closed: not from poses that were corrected since.
        registrations: loop edges, made by `LoopNoise.edge`.

    Raises:
        ValueError: an edge has the wrong kind, or the graph falls apart.
    """
    return _graph(T_world_submap, odometry, registrations)


def keyframe_graph(
    submap: Submap, odometry: Iterable[PoseEdge], loops: Iterable[PoseEdge]
) -> PoseGraph:
    """The graph of one submap's keyframes, in its frame, with its first keyframe fixed.

    Args:
        odometry: edges between neighbouring keyframes (`OdometryNoise.along`); nodes are the
            keyframes' frame indices.
        loops: measured between what the two keyframes observed; two renders of the same map
            would agree whatever the drift.

    Raises:
        ValueError: an edge has the wrong kind, or the graph falls apart.
    """
    return _graph({k.index: k.T_map_camera for k in submap.keyframes}, odometry, loops)


def correct_keyframes(submap: Submap, correction: PoseCorrection) -> None:
    """Move a submap's keyframes, and with each the Gaussians that it seeded.

    Centres alone move: Gaussians are isotropic. They move by float64, and those of keyframes
    that did not move keep their bits.

    Raises:
        ValueError: a keyframe that moves stands elsewhere than the correction starts from, or
            a Gaussian was seeded by none of the submap's keyframes.
    """
    moved = correction.moved
    keyframes = {keyframe.index: keyframe for keyframe in submap.keyframes}
    for node in moved:
        keyframe = keyframes.get(node)
        T_old = correction.T_old[node]
        # A graph makes poses rigid that are not quite.
        if keyframe is None or np.abs(keyframe.T_map_camera - T_old).max() > 1e-4:
            raise ValueError(
                f"keyframe {node} of submap {submap.number} is not where the correction found "
                f"it; build the graph from the submap as it is"
            )
    motions = [correction.motion(node) for node in moved]
    means = _moved_means(submap, moved, motions)
    for node in moved:
        keyframes[node].T_map_camera = np.array(correction.T_new[node])
    if means is not None:
        submap.gaussians = replace(submap.gaussians, means=means)


def _moved_means(submap: Submap, moved: list[int], motions: list[Array]) -> torch.Tensor | None:
    """Centres [N, 3] after each keyframe's motion; None where none moves."""
    means = submap.gaussians.means
    if submap.seeded_by.shape != (len(means),):
        raise ValueError(
            f"submap {submap.number} has {len(means)} Gaussians, but names the keyframe of "
            f"{len(submap.seeded_by)}"
        )
    if not moved:
        return None
    seeded_by = submap.seeded_by.detach().cpu().numpy()
    strangers = np.setdiff1d(seeded_by, [keyframe.index for keyframe in submap.keyframes])
    if len(strangers):
        raise ValueError(
            f"submap {submap.number} holds Gaussians of frame {strangers[0]}, which is none of "
            f"its keyframes"
        )
    row = np.minimum(np.searchsorted(moved, seeded_by), len(moved) - 1)
    (moving,) = np.nonzero(np.asarray(moved)[row] == seeded_by)
    if len(moving) == 0:
        return None
    T = np.stack(motions)[row[moving]]
    old = means.detach().cpu().numpy()
    new = old.copy()
    centres = np.einsum("nij,nj->ni", T[:, :3, :3], old[moving]) + T[:, :3, 3]
    new[moving] = centres.astype(old.dtype)
    return torch.from_numpy(new).to(means.device)


def _graph(
    poses: Mapping[int, Array], odometry: Iterable[PoseEdge], loops: Iterable[PoseEdge]
) -> PoseGraph:
    odometry, loops = tuple(odometry), tuple(loops)
    for kind, edges in (("odometry", odometry), ("loop", loops)):
        for edge in edges:
            if edge.kind != kind:
                raise ValueError(f"{edge} is of kind {edge.kind!r} where {kind!r} is meant")
    return PoseGraph(poses, (*odometry, *loops))
