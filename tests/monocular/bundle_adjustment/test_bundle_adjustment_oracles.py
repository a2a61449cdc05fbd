"""Optima of other libraries' bundle adjustment: GTSAM and COLMAP."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from types import ModuleType

import gtsam
import numpy as np
import pytest
from bundle_scene import CAMERA, disturbed, scene
from gtsam.symbol_shorthand import L, X

from toolkit.base.geometry import se3
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions, BundleProblem
from toolkit.depth.monocular.bundle_adjustment.solver import adjust

SQUARES = BundleOptions(iterations=100, huber_px=1e6, min_decrease=1e-14)
HUBER = replace(SQUARES, huber_px=1.0)
# Landmarks lie exactly on the ray of their anchor's pixel. GTSAM gets this constraint as a noise of
# so many pixels, and COLMAP by repeating that pixel so many times.
EXACT_PX = 1e-3
REPEATED = 200


@dataclass(frozen=True)
class Optimum:
    """Poses [P, 4, 4], points [L, 3] and the cost of the observations."""

    T_world_camera: np.ndarray
    points: np.ndarray
    cost: float


def noisy(outliers: bool = False) -> BundleProblem:
    """A disturbed problem whose optimum is not the true scene."""
    problem = disturbed(scene(poses=6, landmarks=40, noise_px=0.5))
    if not outliers:
        return problem
    px = problem.observations.px.copy()
    px[::11] += [8.0, -5.0]
    return replace(problem, observations=replace(problem.observations, px=px))


def points_of(problem: BundleProblem, T: np.ndarray, inverse_depth: np.ndarray) -> np.ndarray:
    marks = problem.landmarks
    rays = np.ones((len(marks), 3))
    rays[:, :2] = (marks.anchor_px - [CAMERA.cx, CAMERA.cy]) / [CAMERA.fx, CAMERA.fy]
    local = rays / inverse_depth[:, None]
    return np.einsum("nij,nj->ni", T[marks.anchor][:, :3, :3], local) + T[marks.anchor][:, :3, 3]


def ours(problem: BundleProblem, options: BundleOptions) -> Optimum:
    found = adjust(problem, options)
    points = points_of(problem, found.T_world_camera, found.inverse_depth)
    return Optimum(found.T_world_camera, points, found.cost)


def gtsam_optimum(problem: BundleProblem, huber_px: float | None) -> Optimum:
    marks, seen = problem.landmarks, problem.observations
    K = gtsam.Cal3_S2(CAMERA.fx, CAMERA.fy, 0.0, CAMERA.cx, CAMERA.cy)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, 1.0)
    if huber_px is not None:
        kernel = gtsam.noiseModel.mEstimator.Huber.Create(huber_px)
        pixel = gtsam.noiseModel.Robust.Create(kernel, pixel)
    anchors, graph = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph()
    values = gtsam.Values()
    exact = gtsam.noiseModel.Isotropic.Sigma(2, EXACT_PX)
    factor = gtsam.GenericProjectionFactorCal3_S2
    for pose, T in enumerate(problem.T_world_camera):
        values.insert(X(pose), gtsam.Pose3(T))
        if problem.fixed[pose]:
            anchors.add(gtsam.NonlinearEqualityPose3(X(pose), gtsam.Pose3(T)))
    start = points_of(problem, problem.T_world_camera, marks.inverse_depth)
    for mark, point in enumerate(start):
        values.insert(L(mark), point)
        anchors.add(factor(marks.anchor_px[mark], exact, X(marks.anchor[mark]), L(mark), K))
    for mark, pose, px in zip(seen.landmark, seen.pose, seen.px, strict=True):
        graph.add(factor(px, pixel, X(pose), L(mark), K))
    both = gtsam.NonlinearFactorGraph(graph)
    both.push_back(anchors)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    # It would stop early in the narrow valleys along the anchors' rays.
    parameters.setlambdaUpperBound(1e20)
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    found = gtsam.LevenbergMarquardtOptimizer(both, values, parameters).optimize()
    return Optimum(
        np.array([found.atPose3(X(p)).matrix() for p in range(len(problem.fixed))]),
        np.array([found.atPoint3(L(m)) for m in range(len(marks))]),
        graph.error(found),
    )


@pytest.mark.parametrize("outliers", [False, True])
def test_gtsam_finds_the_same_optimum(outliers):
    problem = noisy(outliers)
    found = ours(problem, HUBER if outliers else SQUARES)
    expected = gtsam_optimum(problem, 1.0 if outliers else None)
    assert found.cost == pytest.approx(expected.cost, rel=1e-5)
    np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-6)
    np.testing.assert_allclose(found.points, expected.points, atol=1e-5)


@pytest.fixture(scope="module")
def pycolmap() -> ModuleType:
    """COLMAP; the other two must be loaded before it, or writing PNG files aborts later on."""
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    return [importlib.import_module(name) for name in ("cv2", "open3d", "pycolmap")][-1]


def colmap_optimum(pycolmap: ModuleType, problem: BundleProblem) -> Optimum:
    marks, seen = problem.landmarks, problem.observations
    parameters = [CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy]
    world = pycolmap.Reconstruction()
    world.add_camera_with_trivial_rig(
        pycolmap.Camera(
            model="PINHOLE",
            width=CAMERA.width,
            height=CAMERA.height,
            params=parameters,
            camera_id=1,
        )
    )
    rows: list[list[int]] = [[] for _ in range(len(problem.fixed))]
    pixels: list[list[np.ndarray]] = [[] for _ in rows]
    pairs = [*zip(marks.anchor, range(len(marks)), marks.anchor_px, strict=True)] * REPEATED
    pairs += zip(seen.pose, seen.landmark, seen.px, strict=True)
    for pose, mark, px in pairs:
        rows[pose].append(int(mark))
        pixels[pose].append(px)
    config = pycolmap.BundleAdjustmentConfig()
    tracks = [pycolmap.Track() for _ in range(len(marks))]
    for pose, T in enumerate(problem.T_world_camera):
        image = pycolmap.Image(f"{pose}", np.array(pixels[pose]), 1, pose + 1)
        world.add_image_with_trivial_frame(image, pycolmap.Rigid3d(se3.inverse(T)[:3]))
        config.add_image(pose + 1)
        if problem.fixed[pose]:
            config.set_constant_rig_from_world_pose(pose + 1)
        for number, mark in enumerate(rows[pose]):
            tracks[mark].add_element(pose + 1, number)
    start = points_of(problem, problem.T_world_camera, marks.inverse_depth)
    numbers = [world.add_point3D(point, track) for point, track in zip(start, tracks, strict=True)]
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False, refine_extra_params=False, print_summary=False
    )
    options.ceres.solver_options.gradient_tolerance = 1e-10
    pycolmap.create_default_bundle_adjuster(options, config, world).solve()
    T_camera_world = np.array(
        [
            np.vstack([world.images[p + 1].cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
            for p in range(len(problem.fixed))
        ]
    )
    points = np.array([world.points3D[number].xyz for number in numbers])
    T = T_camera_world[seen.pose]
    local = np.einsum("nij,nj->ni", T[:, :3, :3], points[seen.landmark]) + T[:, :3, 3]
    error = CAMERA.project(local) - seen.px
    return Optimum(se3.inverse(T_camera_world), points, 0.5 * float((error**2).sum()))


def test_colmap_finds_the_same_optimum(pycolmap):
    problem = noisy()
    expected = colmap_optimum(pycolmap, problem)
    found = ours(problem, SQUARES)
    assert found.cost == pytest.approx(expected.cost, rel=0.02)
    np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=2e-4)
    np.testing.assert_allclose(found.points, expected.points, atol=5e-3)
