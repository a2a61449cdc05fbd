"""Conversion of pose graph files to pose graphs."""

from __future__ import annotations

import numpy as np

from toolkit.io.pose_graphs import PoseGraphArrays
from toolkit.loops.pose_graph.graph import PoseEdge, PoseGraph, poses_along


def graph_of(arrays: PoseGraphArrays) -> PoseGraph:
    """Build a pose graph from file arrays; edges k to k + 1 are odometry, all others loops.

    If the file has no poses, they are composed along the edges. The fixed node is the first fixed
    node in the file, or else the lowest node number.

    Raises:
        ValueError: an edge or the graph is invalid (see `PoseEdge` and `PoseGraph`).
    """
    edges = tuple(
        PoseEdge(int(i), int(j), T, information)
        if j == i + 1
        else PoseEdge.loop(int(i), int(j), T, information)
        for (i, j), T, information in zip(
            arrays.edges, arrays.T_first_second, arrays.information, strict=True
        )
    )
    poses = {int(n): T for n, T in zip(arrays.nodes, arrays.T_world_node, strict=True)}
    if not poses:
        poses = poses_along(edges, int(arrays.edges.min()), np.eye(4))
    fixed = int(arrays.fixed[0]) if len(arrays.fixed) else None
    return PoseGraph(poses, edges, fixed)
