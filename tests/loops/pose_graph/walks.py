"""Synthetic camera path through two identical rooms with noisy odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pose_graph_files import poses_along

from toolkit.base.geometry import se3
from toolkit.base.pose_graph.graph import PoseEdge, PoseGraph, information_of

Array = NDArray[np.float64]

ROOM = 8  # nodes of one circle through a room
CORRIDOR = 2
APART_M = 6.0


def covariance(sigma_m: float, sigma_rad: float) -> Array:
    """Anisotropic covariance with correlated translation and rotation."""
    shape = np.eye(6)
    shape[:3, 3:] = 0.3 * se3.hat(np.array([0.2, 0.5, 1.0]))
    sigmas = np.array([1.0, 1.5, 0.7])
    scale = np.diag(np.concatenate([sigma_m * sigmas, sigma_rad * sigmas[::-1]]))
    return scale @ shape @ shape.T @ scale


ODOMETRY = covariance(0.01, 0.006)
LOOP = covariance(0.02, 0.01)


@dataclass(frozen=True)
class Walk:
    """Camera path: circle in room A, circle in room B, circle in room A.

    Attributes:
        T_world_node: [N, 4, 4] true poses; room A is nodes 0..7 and 20..27, B 10..17.
        odometry: noisy edges between neighbours.
        seed: random seed of the noise.
    """

    T_world_node: Array
    odometry: tuple[PoseEdge, ...]
    seed: int

    def loop(self, first: int, second: int) -> PoseEdge:
        """A true loop, measured with noise."""
        T = se3.inverse(self.T_world_node[first]) @ self.T_world_node[second]
        return PoseEdge.loop(first, second, self._noisy(T, first, second), information_of(LOOP))

    def twin_loop(self, first: int, second: int) -> PoseEdge:
        """A wrong loop that aligns room B to room A, with the noise of a true loop."""
        T_a_b = np.eye(4)
        T_a_b[0, 3] = -APART_M
        shifted = T_a_b @ self.T_world_node[second]
        T = se3.inverse(self.T_world_node[first]) @ shifted
        return PoseEdge.loop(first, second, self._noisy(T, first, second), information_of(LOOP))

    def _noisy(self, T: Array, first: int, second: int) -> Array:
        rng = np.random.default_rng([self.seed, first, second])
        return T @ se3.exp(np.linalg.cholesky(LOOP) @ rng.normal(size=6))

    def graph(self, *loops: PoseEdge) -> PoseGraph:
        """Graph initialised with odometry poses."""
        poses = poses_along(self.odometry, 0, self.T_world_node[0])
        return PoseGraph(poses, (*self.odometry, *loops))

    def errors_m(self, T_world_node: dict[int, Array]) -> Array:
        """[N] position errors, metres."""
        found = np.stack([T_world_node[n] for n in range(len(self.T_world_node))])
        return np.linalg.norm(found[:, :3, 3] - self.T_world_node[:, :3, 3], axis=1)


def walk(seed: int) -> Walk:
    """The camera path with the noise of a seed."""
    rng = np.random.default_rng(seed)
    truth = np.stack(_true_poses())
    edges = []
    for k in range(len(truth) - 1):
        T = se3.inverse(truth[k]) @ truth[k + 1]
        noise = se3.exp(np.linalg.cholesky(ODOMETRY) @ rng.normal(size=6))
        edges.append(PoseEdge(k, k + 1, T @ noise, information_of(ODOMETRY)))
    return Walk(truth, tuple(edges), seed)


def _true_poses() -> list[Array]:
    def standing(x: float, y: float, heading_rad: float) -> Array:
        R = se3.exp_so3(np.array([0.0, 0.0, heading_rad]))
        return se3.from_rotation_translation(R, np.array([x, y, 1.0 + 0.1 * np.sin(3 * x)]))

    def round_room(x: float) -> list[Array]:
        angles = 2 * np.pi * np.arange(ROOM) / ROOM
        return [standing(x + np.cos(a), np.sin(a), a + np.pi / 2) for a in angles]

    steps = (np.arange(CORRIDOR) + 1) / (CORRIDOR + 1)
    there = [standing(1.0 + s * APART_M, -0.5, 0.1) for s in steps]
    back = [standing(1.0 + (1 - s) * APART_M, 0.5, np.pi) for s in steps]
    return [*round_room(0.0), *there, *round_room(APART_M), *back, *round_room(0.0)]


def composed(edges: Sequence[PoseEdge]) -> PoseEdge:
    """Compose consecutive odometry edges into one; their covariances are propagated.

    T_a_b exp(x) T_b_c exp(y) = T_a_b T_b_c exp(adjoint(T_c_b) x) exp(y), to first order.
    """
    T, covariance, end = edges[0].T_first_second, edges[0].covariance, edges[0].second
    for edge in edges[1:]:
        assert edge.first == end
        A = se3.adjoint(se3.inverse(edge.T_first_second))
        T = se3.orthonormalise(T @ edge.T_first_second)
        covariance = A @ covariance @ A.T + edge.covariance
        end = edge.second
    return PoseEdge(edges[0].first, end, T, information_of(covariance))
