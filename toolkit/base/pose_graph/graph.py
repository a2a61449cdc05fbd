"""Pose graph data: poses of nodes and relative pose measurements between them.

A node is a submap anchor or a keyframe. `T_world_node` is its pose in the graph's world frame,
which is the submap's frame for the keyframes of a submap.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3

Array = NDArray[np.float64]
EdgeKind = Literal["odometry", "loop"]

# Tolerances: poses within _RIGID (float32 precision) are orthonormalised; poses within _EXACT are
# kept unchanged.
_RIGID, _EXACT = 1e-5, 1e-10


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """A relative pose measurement between two nodes.

    Attributes:
        first, second: node numbers.
        T_first_second: [4, 4] float64, the measurement of inverse(T_first) @ T_second.
        information: [6, 6] float64 inverse covariance of x in T_first_second exp(x), with
            x = (translation m, rotation rad): a perturbation in the second node's frame.
        kind: "odometry", which is always kept, or "loop", which may be retracted.
        robust: whether the solver applies its robust kernel.

    Raises:
        ValueError: the transformation is not rigid, the information is not symmetric positive
            definite, or both nodes are the same.
    """

    first: int
    second: int
    T_first_second: Array = field(repr=False)
    information: Array = field(repr=False)
    kind: EdgeKind = "odometry"
    robust: bool = False

    def __post_init__(self) -> None:
        name = f"edge {self.first}-{self.second}"
        if self.first == self.second:
            raise ValueError(f"{name} connects a node to itself")
        if self.kind not in ("odometry", "loop"):
            raise ValueError(f"{name}: kind must be 'odometry' or 'loop', got {self.kind!r}")
        T = _rigid(f"{name}: T_first_second", self.T_first_second)
        information = np.array(self.information, dtype=np.float64)
        _check_information(name, information)
        object.__setattr__(self, "T_first_second", T)
        object.__setattr__(self, "information", 0.5 * (information + information.T))

    @classmethod
    def loop(cls, first: int, second: int, T_first_second: Array, information: Array) -> PoseEdge:
        """Make a loop edge with the robust kernel."""
        return cls(first, second, T_first_second, information, "loop", robust=True)

    @property
    def covariance(self) -> Array:
        """[6, 6] inverse of the information."""
        return _symmetric_inverse(self.information)

    def then(self, following: PoseEdge) -> PoseEdge:
        """The motion to the end of an odometry edge that starts where this one ends."""
        T = se3.orthonormalise(self.T_first_second @ following.T_first_second)
        moved = covariance_in_frame(self.covariance, following.T_first_second)
        information = information_of(moved + following.covariance)
        return PoseEdge(self.first, following.second, T, information)

    def inverted(self) -> PoseEdge:
        """The inverse measurement, from the second node to the first."""
        T_second_first = se3.inverse(self.T_first_second)
        information = information_in_frame(self.information, T_second_first)
        return PoseEdge(
            self.second, self.first, T_second_first, information, self.kind, self.robust
        )

    def residual(self, T_world_first: Array, T_world_second: Array) -> Array:
        """[6] log of the inverse measurement times the relative pose of two nodes."""
        predicted = se3.inverse(T_world_first) @ T_world_second
        return se3.log(se3.inverse(self.T_first_second) @ predicted)

    def chi2(self, T_world_first: Array, T_world_second: Array) -> float:
        """Squared Mahalanobis norm of the residual (6 degrees of freedom)."""
        residual = self.residual(T_world_first, T_world_second)
        return float(residual @ self.information @ residual)


def information_in_frame(information_a: Array, T_a_b: Array) -> Array:
    """Transform the information [6, 6] of a perturbation in frame a to frame b.

    exp(y) T_a_b = T_a_b exp(x) implies y = adjoint(T_a_b) x. Called with a measurement T, this
    converts the information of a left perturbation exp(y) T to that of a right perturbation.
    Called with inverse(T), it converts the information of T to that of inverse(T).
    """
    A = se3.adjoint(T_a_b)
    return A.T @ information_a @ A


def covariance_in_frame(covariance_a: Array, T_a_b: Array) -> Array:
    """Transform the covariance [6, 6] of a pose T_world_a to that of T_world_b = T_world_a T_a_b.

    This yields the covariance of a camera from that of the anchor or keyframe it is attached to.
    """
    A = se3.adjoint(se3.inverse(T_a_b))
    return A @ covariance_a @ A.T


def information_of(covariance: Array) -> Array:
    """Exactly symmetric information [6, 6] of a covariance."""
    return _symmetric_inverse(covariance)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Node poses and the edges between them.

    Attributes:
        T_world_node: [4, 4] float64 pose by node number, the initial values of the optimisation.
        edges: edges; per-edge results use the same order.
        fixed: node that does not move; None selects the lowest number.

    Raises:
        ValueError: a pose is not rigid, an edge refers to an unknown node, or a node is not
            connected to the fixed node.
    """

    T_world_node: Mapping[int, Array]
    edges: tuple[PoseEdge, ...]
    fixed: int | None = None

    def __post_init__(self) -> None:
        poses = {
            int(n): _rigid(f"the pose of node {n}", T) for n, T in sorted(self.T_world_node.items())
        }
        if not poses:
            raise ValueError("a pose graph needs at least one node")
        object.__setattr__(self, "T_world_node", poses)
        object.__setattr__(self, "edges", tuple(self.edges))
        object.__setattr__(self, "fixed", min(poses) if self.fixed is None else int(self.fixed))
        if self.fixed not in poses:
            raise ValueError(f"the fixed node {self.fixed} is not in the pose graph")
        if min(poses) < 0:
            raise ValueError(f"node numbers must not be negative, got {min(poses)}")
        for edge in self.edges:
            missing = {edge.first, edge.second} - poses.keys()
            if missing:
                raise ValueError(f"{edge} refers to node {min(missing)}, which has no pose")
        unreachable = poses.keys() - _reachable(self.anchor, self.edges)
        if unreachable:
            raise ValueError(
                f"node {min(unreachable)} is not connected to the fixed node {self.fixed}; "
                f"add an edge that connects them"
            )

    def __str__(self) -> str:
        loops = sum(edge.kind == "loop" for edge in self.edges)
        return f"{len(self.T_world_node)} nodes, {len(self.edges)} edges, {loops} of them loops"

    @property
    def anchor(self) -> int:
        """Number of the fixed node."""
        assert self.fixed is not None
        return self.fixed

    @property
    def nodes(self) -> list[int]:
        """Ascending node numbers, the order of all arrays over nodes."""
        return list(self.T_world_node)

    def chi2(self, T_world_node: Mapping[int, Array] | None = None) -> Array:
        """[E] chi-square of each edge at the given poses, by default those of the graph."""
        poses = self.T_world_node if T_world_node is None else T_world_node
        return np.array([e.chi2(poses[e.first], poses[e.second]) for e in self.edges])

    def without(self, indices: Iterable[int]) -> PoseGraph:
        """Copy of the graph without the edges at the given indices."""
        removed = set(indices)
        kept = tuple(e for k, e in enumerate(self.edges) if k not in removed)
        return PoseGraph(self.T_world_node, kept, self.fixed)

    def is_connected_without(self, indices: Iterable[int]) -> bool:
        """Whether the graph stays connected without the edges at the given indices."""
        removed = set(indices)
        kept = [e for k, e in enumerate(self.edges) if k not in removed]
        return len(_reachable(self.anchor, kept)) == len(self.T_world_node)

    def at(self, T_world_node: Mapping[int, Array]) -> PoseGraph:
        """Copy of the graph with other poses."""
        return PoseGraph(T_world_node, self.edges, self.fixed)


def _symmetric_inverse(matrix: Array) -> Array:
    inverse = np.linalg.inv(matrix)
    return 0.5 * (inverse + inverse.T)


def _rigid(name: str, T: Array) -> Array:
    T = np.array(T, dtype=np.float64)
    if se3.is_rigid(T, _EXACT):
        return T
    if not se3.is_rigid(T, _RIGID):
        raise ValueError(f"{name} must be a rigid transformation [4, 4]")
    return se3.orthonormalise(T)


def _check_information(name: str, information: Array) -> None:
    if information.shape != (6, 6) or not np.isfinite(information).all():
        raise ValueError(f"{name}: information must be a finite matrix [6, 6]")
    largest = np.abs(information).max()
    if np.abs(information - information.T).max() > 1e-6 * largest:
        raise ValueError(f"{name}: information must be symmetric")
    if np.linalg.eigvalsh(information)[0] <= 1e-14 * largest:
        raise ValueError(
            f"{name}: information must be positive definite; give directions that were not "
            f"measured a large variance"
        )


def adjacent(nodes: Iterable[int], edges: Iterable[PoseEdge]) -> set[int]:
    """The nodes and those that an edge connects to one of them."""
    nodes = set(nodes)
    ends = [{edge.first, edge.second} for edge in edges]
    return nodes.union(*(both for both in ends if both & nodes))


def connected_parts(nodes: Iterable[int], edges: Iterable[PoseEdge]) -> list[tuple[int, ...]]:
    """Group nodes that are connected by edges.

    Returns:
        The ascending nodes of each group, in the order of their lowest nodes.
    """
    parts, edges, remaining = [], tuple(edges), set(nodes)
    while remaining:
        part = _reachable(min(remaining), edges)
        parts.append(tuple(sorted(part)))
        remaining -= part
    return parts


def _reachable(start: int, edges: Iterable[PoseEdge]) -> set[int]:
    neighbours: dict[int, list[int]] = defaultdict(list)
    for edge in edges:
        neighbours[edge.first].append(edge.second)
        neighbours[edge.second].append(edge.first)
    found, waiting = {start}, [start]
    while waiting:
        for other in neighbours[waiting.pop()]:
            if other not in found:
                found.add(other)
                waiting.append(other)
    return found
