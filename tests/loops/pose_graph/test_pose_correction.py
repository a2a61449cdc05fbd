"""Pose corrections of submaps and keyframes."""

from __future__ import annotations

import copy
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.base.pose_graph.graph import PoseEdge
from toolkit.base.pose_graph.solver import solve
from toolkit.slam.loops.correction import (
    PoseCorrection,
    correct_keyframes,
    keyframe_graph,
    submap_graph,
)
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud

FEW = settings(deadline=None, max_examples=15)
seeds = st.integers(0, 2**16)
CAMERA = Camera(fx=5.0, fy=5.0, cx=3.5, cy=2.5, width=8, height=6)
FRAMES = (10, 15, 21, 30)


def motion(rng: np.random.Generator, scale: float = 1.0) -> np.ndarray:
    return se3.exp(scale * rng.normal(size=6))


def keyframe(index: int, T_map_camera: np.ndarray) -> Keyframe:
    return Keyframe(
        index=index,
        timestamp_s=0.1 * index,
        T_map_camera=T_map_camera,
        rgb=torch.zeros(3, 6, 8, dtype=torch.uint8),
        depth_m=torch.ones(6, 8),
        camera=CAMERA,
        exposure=IDENTITY,
        points=np.zeros((0, 3), np.float32),
    )


def submap(seed: int, number: int = 0, count: int = 200) -> Submap:
    rng = np.random.default_rng([seed, number])
    generator = torch.Generator().manual_seed(seed)
    poses = [np.eye(4), *(motion(rng) for _ in FRAMES[1:])]
    cloud = GaussianCloud.from_values(
        means=5 * torch.randn(count, 3, generator=generator),
        radii_m=torch.rand(count, generator=generator) + 0.01,
        opacities=torch.rand(count, generator=generator) * 0.9 + 0.05,
        colours=torch.rand(count, 3, generator=generator),
        features=torch.rand(count, 2, generator=generator),
    )
    return Submap(
        number=number,
        T_world_submap=motion(rng),
        gaussians=cloud,
        keyframes=[keyframe(i, T) for i, T in zip(FRAMES, poses, strict=True)],
        seeded_by=torch.from_numpy(rng.choice(FRAMES, count).astype(np.int32)),
        descriptors=rng.normal(size=(len(FRAMES), 4)).astype(np.float32),
    )


def bits(piece: Submap) -> list[bytes]:
    """Bytes of the content of a submap."""
    cloud = piece.gaussians
    arrays = [cloud.means, cloud.log_radii, cloud.opacity_logits, cloud.colours, cloud.features]
    arrays += [piece.seeded_by, torch.from_numpy(piece.descriptors)]
    out = [a.numpy().tobytes() for a in arrays]
    return out + [a.tobytes() for k in piece.keyframes for a in k.arrays().values()]


def correction_of(piece: Submap, T_new: dict[int, np.ndarray]) -> PoseCorrection:
    T_old = {k.index: k.T_map_camera.copy() for k in piece.keyframes}
    return PoseCorrection(T_old, T_old | T_new)


@FEW
@given(seed=seeds)
def test_identity_correction_is_bit_identical(seed: int) -> None:
    piece = submap(seed)
    before, means = bits(piece), piece.gaussians.means
    correction = correction_of(piece, {})
    assert correction.moved == []
    assert (correction.largest_m, correction.largest_rad) == (0.0, 0.0)
    correct_keyframes(piece, correction)
    assert bits(piece) == before
    assert piece.gaussians.means is means


@FEW
@given(seed=seeds)
def test_gaussians_keep_their_position_relative_to_the_keyframe(seed: int) -> None:
    rng = np.random.default_rng(seed)
    piece = submap(seed)
    old = copy.deepcopy(piece)
    T_new = {15: motion(rng), 30: motion(rng)}
    correct_keyframes(piece, correction_of(piece, T_new))
    for before, after in zip(old.keyframes, piece.keyframes, strict=True):
        own = (old.seeded_by == after.index).numpy()
        expected = T_new.get(after.index, before.T_map_camera)
        assert np.array_equal(after.T_map_camera, expected)
        seen = [
            se3.transform_points(se3.inverse(k.T_map_camera), m.gaussians.means.numpy()[own])
            for k, m in ((before, old), (after, piece))
        ]
        np.testing.assert_allclose(seen[1], seen[0], atol=1e-5)
        if after.index not in T_new:
            same = piece.gaussians.means.numpy()[own] == old.gaussians.means.numpy()[own]
            assert same.all()
    # Centres alone: the rest of every Gaussian is what it was.
    old.gaussians = GaussianCloud(piece.gaussians.means, *_others(old.gaussians))
    for k, o in zip(piece.keyframes, old.keyframes, strict=True):
        o.T_map_camera = k.T_map_camera
    assert bits(piece) == bits(old)


def _others(cloud: GaussianCloud) -> list[torch.Tensor]:
    return [cloud.log_radii, cloud.opacity_logits, cloud.colours, cloud.features]


def test_distant_centres_are_transformed_in_float64() -> None:
    piece = submap(1)
    piece.gaussians = GaussianCloud(piece.gaussians.means + 1000.0, *_others(piece.gaussians))
    piece.seeded_by = torch.full_like(piece.seeded_by, 15)
    old = piece.gaussians.means.numpy().astype(np.float64)
    correction = correction_of(piece, {15: motion(np.random.default_rng(1))})
    correct_keyframes(piece, correction)
    exact = se3.transform_points(correction.motion(15), old).astype(np.float32)
    # The last bit may differ by the order of a sum.
    np.testing.assert_allclose(piece.gaussians.means.numpy(), exact, rtol=2e-7)


def test_largest_translation_and_rotation() -> None:
    piece = submap(6)
    T = piece.keyframes[2].T_map_camera @ se3.exp(np.array([0.3, 0, 0.4, 0, 0.2, 0]))
    correction = correction_of(piece, {21: T})
    assert correction.moved == [21]
    assert correction.largest_m == pytest.approx(0.5, abs=0.01)
    assert correction.largest_rad == pytest.approx(0.2)


def test_loop_within_a_submap_removes_drift() -> None:
    """A loop corrects the drift of keyframes and their Gaussians."""
    piece = submap(7)
    truth = copy.deepcopy(piece)
    drift = se3.exp(np.array([0.03, -0.02, 0.04, 0.01, 0.02, -0.01]))
    drifted, T = {}, np.eye(4)
    for keyframe_ in piece.keyframes:
        drifted[keyframe_.index] = keyframe_.T_map_camera @ T
        T = T @ drift
    correct_keyframes(piece, correction_of(piece, drifted))
    own = piece.seeded_by.numpy() == 30

    def error_m() -> float:
        return float((piece.gaussians.means - truth.gaussians.means)[own].norm(dim=1).max())

    assert error_m() > 0.1
    T_true = truth.keyframes[-1].T_map_camera
    loop = PoseEdge.loop(10, 30, T_true, 1e8 * np.eye(6))
    odometry = []
    for first, second in pairwise(piece.keyframes):
        T = se3.inverse(first.T_map_camera) @ second.T_map_camera
        odometry.append(PoseEdge(first.index, second.index, T, 1e2 * np.eye(6)))
    graph = keyframe_graph(piece, odometry, [loop])
    assert graph.anchor == 10
    correction = PoseCorrection.of(graph, solve(graph, "none"))
    assert correction.covariances.keys() == set(FRAMES)
    correct_keyframes(piece, correction)
    assert np.array_equal(piece.keyframes[0].T_map_camera, np.eye(4))
    np.testing.assert_allclose(piece.keyframes[-1].T_map_camera, T_true, atol=1e-4)
    assert error_m() < 1e-3


def test_submap_graph() -> None:
    pieces = [submap(8, number) for number in range(3)]
    T_world_submap = {0: np.eye(4)}
    edges = []
    for piece, following in pairwise(pieces):
        # The boundary frame belongs to both, so its pose in the first is the motion.
        T = piece.keyframes[-1].T_map_camera
        edge = PoseEdge(piece.number, following.number, T, 1e4 * np.eye(6))
        T_world_submap[following.number] = T_world_submap[piece.number] @ edge.T_first_second
        edges.append(edge)
    truth = T_world_submap[2] @ se3.exp(np.array([0.2, 0, 0, 0, 0.02, 0]))
    registration = PoseEdge.loop(0, 2, truth, 1e8 * np.eye(6))
    graph = submap_graph(T_world_submap, edges, [registration])
    assert (graph.nodes, graph.anchor) == ([0, 1, 2], 0)
    solution = solve(graph, "none")
    np.testing.assert_allclose(solution.T_world_node[2], truth, atol=1e-3)
