"""Pose graphs as plain data: poses of nodes, and measured motions between them.

A node is a submap's anchor or a keyframe; `T_world_node` is its pose in the graph's own
world, which for the keyframes of a submap is the submap's frame.
"""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3

Array = NDArray[np.float64]
EdgeKind = Literal["odometry", "loop"]

# Motions that were float32 on their way pass, and are made rigid; float64 ones keep their bits.
_RIGID, _EXACT = 1e-5, 1e-10


@dataclass(frozen=True, eq=False)
class PoseEdge:
    """A measured motion between two nodes.

    Attributes:
        first, second: the nodes' numbers.
        T_first_second: [4, 4] float64, the measurement of inverse(T_first) @ T_second.
        information: [6, 6] float64 inverse covariance of x in T_first_second exp(x), with
            x = (translation m, rotation rad): a perturbation in the second node's frame.
        kind: "odometry", which is believed, or "loop", which may be refused.
        robust: whether the solver puts its robust kernel on it.

    Raises:
        ValueError: the motion is not rigid, the information not symmetric and positive
            definite, or both ends are one node.
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
            raise ValueError(f"{name} joins a node with itself")
        if self.kind not in ("odometry", "loop"):
            raise ValueError(f"{name}: kind must be 'odometry' or 'loop', got {self.kind!r}")
        T = _rigid(f"{name}: T_first_second", self.T_first_second)
        information = np.array(self.information, dtype=np.float64)
        _check_information(name, information)
        object.__setattr__(self, "T_first_second", T)
        object.__setattr__(self, "information", 0.5 * (information + information.T))

    @classmethod
    def loop(cls, first: int, second: int, T_first_second: Array, information: Array) -> PoseEdge:
        """A loop edge, under the robust kernel."""
        return cls(first, second, T_first_second, information, "loop", robust=True)

    @property
    def covariance(self) -> Array:
        """[6, 6] inverse of the information."""
        return _symmetric_inverse(self.information)

    def inverted(self) -> PoseEdge:
        """The same measurement told from the second node."""
        T_second_first = se3.inverse(self.T_first_second)
        information = information_in_frame(self.information, T_second_first)
        return PoseEdge(
            self.second, self.first, T_second_first, information, self.kind, self.robust
        )

    def residual(self, T_world_first: Array, T_world_second: Array) -> Array:
        """[6] log of the measurement's inverse times the motion between two poses."""
        predicted = se3.inverse(T_world_first) @ T_world_second
        return se3.log(se3.inverse(self.T_first_second) @ predicted)

    def chi2(self, T_world_first: Array, T_world_second: Array) -> float:
        """Squared length of the residual in standard deviations, of 6 degrees of freedom."""
        residual = self.residual(T_world_first, T_world_second)
        return float(residual @ self.information @ residual)


def information_in_frame(information_a: Array, T_a_b: Array) -> Array:
    """Information [6, 6] of a perturbation in frame a, told as one in frame b.

    exp(y) T_a_b = T_a_b exp(x) makes y = adjoint(T_a_b) x. So the information of an error
    on the left of a measurement T, exp(y) T, becomes that on its right by T itself; and
    that of inverse(T) follows from T's by inverse(T).
    """
    A = se3.adjoint(T_a_b)
    return A.T @ information_a @ A


def covariance_in_frame(covariance_a: Array, T_a_b: Array) -> Array:
    """Covariance [6, 6] of a pose T_world_a, as that of T_world_b where b hangs on a.

    So the spread of an anchor or a keyframe becomes that of a camera placed relative to it.
    """
    A = se3.adjoint(se3.inverse(T_a_b))
    return A @ covariance_a @ A.T


def information_of(covariance: Array) -> Array:
    """Information [6, 6] of a covariance, symmetric to the bit."""
    return _symmetric_inverse(covariance)


@dataclass(frozen=True, eq=False)
class PoseGraph:
    """Poses and the edges between them.

    Attributes:
        T_world_node: [4, 4] float64 of each node, by number: where optimisation starts.
        edges: in an order that results keep.
        fixed: the node that does not move; None takes the lowest number.

    Raises:
        ValueError: a pose is not rigid, an edge ends at no node, or a part of the graph has
            no connection to the fixed node.
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
                raise ValueError(f"{edge} ends at node {min(missing)}, which has no pose")
        apart = poses.keys() - _reachable(self.anchor, self.edges)
        if apart:
            raise ValueError(
                f"node {min(apart)} is not connected to the fixed node {self.fixed}; "
                f"every node needs a chain of edges to it"
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
        """Numbers of the nodes, ascending: the order of all arrays over nodes."""
        return list(self.T_world_node)

    def chi2(self, T_world_node: Mapping[int, Array] | None = None) -> Array:
        """[E] chi-square of each edge, at the graph's own poses or at others."""
        poses = self.T_world_node if T_world_node is None else T_world_node
        return np.array([e.chi2(poses[e.first], poses[e.second]) for e in self.edges])

    def without(self, places: Iterable[int]) -> PoseGraph:
        """The graph without the edges at some places of `edges`."""
        left_out = set(places)
        kept = tuple(e for k, e in enumerate(self.edges) if k not in left_out)
        return PoseGraph(self.T_world_node, kept, self.fixed)

    def holds_without(self, places: Iterable[int]) -> bool:
        """Whether every node is still connected when the edges at some places are left out."""
        left_out = set(places)
        kept = [e for k, e in enumerate(self.edges) if k not in left_out]
        return len(_reachable(self.anchor, kept)) == len(self.T_world_node)

    def at(self, T_world_node: Mapping[int, Array]) -> PoseGraph:
        """The same edges at other poses."""
        return PoseGraph(T_world_node, self.edges, self.fixed)


def poses_along(edges: Iterable[PoseEdge], start: int, T_world_start: Array) -> dict[int, Array]:
    """A pose for every node that edges connect with `start`, by the fewest edges.

    Of equally short ways the edges that come first count.
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


def _symmetric_inverse(matrix: Array) -> Array:
    inverse = np.linalg.inv(matrix)
    return 0.5 * (inverse + inverse.T)


def _rigid(name: str, T: Array) -> Array:
    T = np.array(T, dtype=np.float64)
    if se3.is_rigid(T, _EXACT):
        return T
    if not se3.is_rigid(T, _RIGID):
        raise ValueError(f"{name} must be a rigid motion [4, 4]")
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
