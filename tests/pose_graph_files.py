"""Pose-graph files in the text formats of g2o and TORO.

    VERTEX_SE3:QUAT id x y z qx qy qz qw
    EDGE_SE3:QUAT first second x y z qx qy qz qw I11 I12 ... I66
    FIX id
    VERTEX3 id x y z roll pitch yaw
    EDGE3 first second x y z roll pitch yaw I11 I12 ... I66

The pose is T_world_node, the measurement T_first_second. The 21 numbers are the upper triangle
of the information matrix, translation before rotation. TORO's angles are rotations about the
fixed axes x, y, z in that order. g2o's own rotation residual is the vector part of the
quaternion, which is half the angle. Here, as in GTSAM, the information refers to radians, so
that optima agree with published ones; relative to g2o's residual, rotations have four times the
weight.
"""

from __future__ import annotations

import os
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge, PoseGraph
from toolkit.io.trajectories import text_lines

PathLike = str | os.PathLike[str]
Array = NDArray[np.float64]

_TRIANGLE = np.triu_indices(6)
# Number of values after the node ids, by tag.
_VERTICES = {"VERTEX_SE3:QUAT": 7, "VERTEX3": 6}
_EDGES = {"EDGE_SE3:QUAT": 28, "EDGE3": 27}


@dataclass(frozen=True)
class PoseGraphArrays:
    """Content of a pose-graph file.

    Attributes:
        nodes: [N] int64 node ids, ascending; empty for TORO files that contain only edges.
        T_world_node: [N, 4, 4] float64.
        edges: [E, 2] int64 ids of the first and second node, in the file's order.
        T_first_second: [E, 4, 4] float64.
        information: [E, 6, 6] float64, of (translation m, rotation rad).
        fixed: [F] int64 ids of fixed nodes.
    """

    nodes: NDArray[np.int64]
    T_world_node: Array
    edges: NDArray[np.int64]
    T_first_second: Array
    information: Array
    fixed: NDArray[np.int64]


def read_pose_graph(path: PathLike) -> PoseGraphArrays:
    """Read a g2o file or a `.txt` file of GTSAM or TORO; the tag determines the type of a line.

    Raises:
        DatasetError: the file cannot be read.
        FormatError: a line is invalid, a node is defined twice, or there is no edge.
    """
    poses: dict[int, Array] = {}
    edges: list[tuple[int, int]] = []
    motions: list[Array] = []
    informations: list[Array] = []
    fixed: list[int] = []
    for number, line in text_lines(path):
        where = f"{path}, line {number}"
        tag, *words = line.split()
        if tag in _VERTICES:
            (node,), values = _numbers(where, tag, words, 1, _VERTICES[tag])
            if node in poses:
                raise FormatError(f"{where}: node {node} is defined twice; remove the line")
            poses[node] = _motion(where, values)
        elif tag in _EDGES:
            (first, second), values = _numbers(where, tag, words, 2, _EDGES[tag])
            edges.append((first, second))
            motions.append(_motion(where, values[:-21]))
            informations.append(_information(values[-21:]))
        elif tag == "FIX":
            fixed += _numbers(where, tag, words, len(words), 0)[0]
        else:
            known = ", ".join((*_VERTICES, *_EDGES, "FIX"))
            raise FormatError(
                f"{where}: {tag!r} is not a tag of a 3D pose graph; supported: {known}"
            )
    if not edges:
        raise FormatError(f"{path} contains no edges; check that it is a pose graph")
    order = sorted(poses)
    return PoseGraphArrays(
        nodes=np.array(order, dtype=np.int64),
        T_world_node=np.array([poses[n] for n in order]).reshape(-1, 4, 4),
        edges=np.array(edges, dtype=np.int64),
        T_first_second=np.array(motions),
        information=np.array(informations),
        fixed=np.array(fixed, dtype=np.int64),
    )


def poses_along(edges: Sequence[PoseEdge], start: int, T_world_start: Array) -> dict[int, Array]:
    """Compose poses along edges for all nodes connected to `start` (breadth-first search).

    Each node uses a shortest path; ties are resolved by the order of the edges.
    """
    neighbours: dict[int, list[tuple[int, Array]]] = defaultdict(list)
    for edge in edges:
        neighbours[edge.first].append((edge.second, edge.T_first_second))
        neighbours[edge.second].append((edge.first, se3.inverse(edge.T_first_second)))
    poses = {start: np.array(T_world_start, dtype=np.float64)}
    waiting = deque([start])
    while waiting:
        node = waiting.popleft()
        for other, T_node_other in neighbours[node]:
            if other not in poses:
                poses[other] = se3.orthonormalise(poses[node] @ T_node_other)
                waiting.append(other)
    return poses


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


def _numbers(
    where: str, tag: str, words: list[str], integers: int, reals: int
) -> tuple[list[int], Array]:
    if len(words) != integers + reals:
        raise FormatError(
            f"{where}: {tag} needs {integers + reals} numbers, got {len(words)}; fix the line"
        )
    try:
        nodes = [int(word) for word in words[:integers]]
        values = np.array([float(word) for word in words[integers:]], dtype=np.float64)
    except ValueError as error:
        raise FormatError(f"{where}: {error}; fix the line") from error
    if min(nodes, default=0) < 0 or not np.isfinite(values).all():
        raise FormatError(
            f"{where}: values must be finite and node ids must not be negative; fix the line"
        )
    return nodes, values


def _motion(where: str, values: Array) -> Array:
    """Return the motion of a translation followed by a quaternion (7) or three angles (6)."""
    if len(values) == 6:
        R = np.eye(3)
        for axis, angle_rad in zip(np.eye(3), values[3:], strict=True):
            R = se3.exp_so3(angle_rad * axis) @ R
        return se3.from_rotation_translation(R, values[:3])
    # Tolerate rounding to a few decimals; larger deviations indicate another column order.
    if abs(np.linalg.norm(values[3:]) - 1.0) > 1e-2:
        raise FormatError(f"{where}: the quaternion (x y z w) does not have norm 1; fix the line")
    return se3.from_rotation_translation(se3.rotation_from_quaternion_xyzw(values[3:]), values[:3])


def _information(values: Array) -> Array:
    out = np.zeros((6, 6))
    out[_TRIANGLE] = values
    return out + np.triu(out, 1).T
