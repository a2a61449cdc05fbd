"""How well image points determine the scale along a sequence."""

from __future__ import annotations

import numpy as np

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.monocular.visual_odometry.landmarks import OdometryView
from toolkit.depth.monocular.visual_odometry.scale_drift import scale_matters, scale_sigma
from toolkit.depth.monocular.visual_odometry.sparse_map import PointTracks, SparseMap
from toolkit.semantics.features.tracks import NO_FEATURES

CAMERA = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)


def sparse_map(poses: np.ndarray, points: np.ndarray) -> SparseMap:
    """A map in which every view shows the points that it can see."""
    made = SparseMap(CAMERA)
    made.views = [OdometryView(n, T, NO_FEATURES) for n, T in enumerate(poses)]
    anchors, px, inverse_depth, seen = [], [], [], []
    for point in points:
        shown = []
        for n, T in enumerate(poses):
            local = se3.transform_points(se3.inverse(T), point[None])[0]
            at = CAMERA.project(local[None])[0]
            if local[2] > 0.1 and (at > 0).all() and (at < [320, 240]).all():
                shown.append((n, at, local[2]))
        if len(shown) > 1:
            seen += [(len(anchors), n, at) for n, at, _ in shown]
            anchors.append(shown[0][0])
            px.append(shown[0][1])
            inverse_depth.append(1.0 / shown[0][2])
    made.add(
        PointTracks(
            np.array(anchors, np.int32),
            np.array(px),
            np.array(inverse_depth),
            np.array([point for point, _, _ in seen]),
            np.array([n for _, n, _ in seen]),
            np.array([at for _, _, at in seen]),
        )
    )
    return made


def wall(count: int, start: float, end: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([start, -1.0, 1.8], [end, 1.0, 3.0], (count, 3))


def sideways(count: int) -> np.ndarray:
    return np.array([se3.exp([0.15 * n, 0.0, 0.0, 0.0, 0.0, 0.0]) for n in range(count)])


def test_parallax_on_both_sides_determines_the_scale():
    sigma = scale_sigma(sparse_map(sideways(8), wall(300, -1.0, 2.5)))
    assert sigma.shape == (7,)
    # Nothing but one view is before the first gap.
    assert sigma[0] > 100.0
    assert (sigma[1:-1] < 0.01).all()


def test_few_common_points_leave_it_uncertain():
    here, there = sideways(4), sideways(4)
    there[:, 0, 3] += 10.0
    poses = np.concatenate([here, there])
    # Between the walls, only far points are visible from both ends.
    points = np.concatenate([wall(200, -1.0, 1.5), wall(200, 9.0, 11.5)])
    far = np.array([[5.0, 0.1, 30.0], [4.0, -0.2, 30.0]])
    sigma = scale_sigma(sparse_map(poses, np.concatenate([points, far])))
    assert sigma[3] > 10.0 * np.median(np.delete(sigma, [0, 3]))


def test_a_turn_in_place_leaves_it_uncertain():
    turns = np.array([se3.exp([0.0, 0.0, 0.0, 0.0, 0.2 * n, 0.0]) for n in range(1, 5)])
    walk = sideways(4)
    rng = np.random.default_rng(1)
    around = rng.normal(size=(600, 3))
    around *= 2.0 / np.linalg.norm(around, axis=1, keepdims=True)
    steady = scale_sigma(sparse_map(sideways(8), wall(300, -1.0, 2.5)))[1:-1].max()
    turning = scale_sigma(sparse_map(np.concatenate([walk, walk[-1] @ turns]), around))
    assert turning[4:].max() > 10.0 * steady


def test_gaps_beside_a_camera_at_rest_do_not_matter():
    rest, walk = np.repeat(sideways(1), 4, axis=0), sideways(6)
    poses = np.concatenate([rest, walk[1:], np.repeat(walk[-1:], 3, axis=0)])
    matters = scale_matters(sparse_map(poses, wall(300, -1.0, 2.5)))
    assert matters.tolist() == [False] * 4 + [True] * 3 + [False] * 4
