"""Pose graphs to and from the arrays of their files."""

from __future__ import annotations

import numpy as np

from toolkit.io.pose_graphs import PoseGraphArrays
from toolkit.pose_graph.graph import PoseEdge, PoseGraph, poses_along


def graph_of(arrays: PoseGraphArrays) -> PoseGraph:
    """The graph of a file: an edge from one number to the next is odometry, others are loops.

    Nodes without a pose in the file get it along the edges. Files know one fixed node here:
    the first that they name, or the lowest number.

    Raises:
        ValueError: an edge or the graph is not as `PoseEdge` and `PoseGraph` want it.
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
