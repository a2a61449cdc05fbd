"""Apply a solved pose graph to submap anchors, or to keyframes and their Gaussians.

G multiplies every pose of a submap by inverse(T_new) T_old. Here poses are stored in the submap's
frame, so the content of a submap is unchanged when its anchor moves. Within a submap, Gaussians
follow the keyframe that seeded them by T_new inverse(T_old).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge, PoseGraph
from toolkit.base.pose_graph.solver import PoseGraphSolution
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseCorrection:
    """Poses of a graph's nodes before and after optimisation.

    Attributes:
        T_old, T_new: [4, 4] float64 by node. A node is a submap number (T_world_submap) or the
            frame index of a keyframe (T_submap_camera).
        covariances: [6, 6] covariance of x in T_new exp(x), by node; empty if not computed.
    """

    T_old: Mapping[int, Array] = field(repr=False)
    T_new: Mapping[int, Array] = field(repr=False)
    covariances: Mapping[int, Array] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, graph: PoseGraph, solution: PoseGraphSolution) -> PoseCorrection:
        """Correction from the poses of the graph to those of the solution."""
        covariances: dict[int, Array] = {}
        if solution.covariances is not None:
            covariances = dict(zip(graph.nodes, solution.covariances, strict=True))
        return cls(dict(graph.T_world_node), dict(solution.T_world_node), covariances)

    @property
    def moved(self) -> list[int]:
        """Ascending nodes whose old and new poses are not identical."""
        return sorted(n for n, T in self.T_new.items() if not np.array_equal(T, self.T_old[n]))

    def motion(self, node: int) -> Array:
        """[4, 4] T_new inverse(T_old), which moves everything attached to the node."""
        return self.T_new[node] @ se3.inverse(self.T_old[node])

    @property
    def largest_m(self) -> float:
        """Largest translation of a node, metres."""
        steps = [self.T_new[n][:3, 3] - T[:3, 3] for n, T in self.T_old.items()]
        return max((float(np.linalg.norm(step)) for step in steps), default=0.0)

    @property
    def largest_rad(self) -> float:
        """Largest rotation of a node, radians."""
        turns = [T[:3, :3].T @ self.T_new[n][:3, :3] for n, T in self.T_old.items()]
        return max((float(se3.rotation_angle_rad(R)) for R in turns), default=0.0)


def submap_graph(
    T_world_submap: Mapping[int, Array],
    odometry: Iterable[PoseEdge],
    registrations: Iterable[PoseEdge],
) -> PoseGraph:
    """Build the pose graph of submaps, with the anchor of the first submap fixed.

    Args:
        T_world_submap: [4, 4] anchor pose by submap number.
        odometry: edges between consecutive anchors as measured when the submap was closed, not
            computed from poses corrected since.
        registrations: loop edges made by `LoopNoise.edge`.

    Raises:
        ValueError: the graph is not connected.
    """
    return PoseGraph(T_world_submap, (*odometry, *registrations))


def keyframe_graph(
    submap: Submap, odometry: Iterable[PoseEdge], loops: Iterable[PoseEdge]
) -> PoseGraph:
    """Build the pose graph of a submap's keyframes in its frame, with the first keyframe fixed.

    Args:
        submap: its keyframes are the nodes, numbered by frame index.
        odometry: edges between consecutive keyframes (`OdometryNoise.along`).
        loops: loop edges measured between the images of two keyframes. Two renderings of the same
            map would agree regardless of the drift.

    Raises:
        ValueError: the graph is not connected.
    """
    poses = {k.index: k.T_map_camera for k in submap.keyframes}
    return PoseGraph(poses, (*odometry, *loops))


def correct_keyframes(submap: Submap, correction: PoseCorrection) -> None:
    """Move the keyframes of a submap and the Gaussians that each keyframe seeded.

    Gaussians are isotropic, so only their centres change. Centres are transformed in float64;
    Gaussians of unchanged keyframes stay bit-identical.
    """
    moved = correction.moved
    keyframes = {keyframe.index: keyframe for keyframe in submap.keyframes}
    motions = [correction.motion(node) for node in moved]
    means = _moved_means(submap, moved, motions)
    for node in moved:
        keyframes[node].T_map_camera = np.array(correction.T_new[node])
    if means is not None:
        submap.gaussians = replace(submap.gaussians, means=means)


def _moved_means(submap: Submap, moved: list[int], motions: list[Array]) -> torch.Tensor | None:
    """Centres [N, 3] after the motion of their keyframes; None if no centre moves."""
    means = submap.gaussians.means
    if not moved:
        return None
    seeded_by = submap.seeded_by.detach().cpu().numpy()
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
