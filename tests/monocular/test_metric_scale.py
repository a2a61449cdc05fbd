"""Metric scale of a motion from a known length."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from moving_camera import error_m, film, walk
from test_camera_motion import Film, motion_of

from toolkit.base.errors import SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.depth.depth_priors.multi_view import SweptKeyframe
from toolkit.depth.monocular.floor import height_above_floor
from toolkit.depth.monocular.markers import MarkerView, detect_markers, side_length
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.depth.monocular.options import ScaleOptions
from toolkit.depth.monocular.scale import check_scale, scaled, with_metric_scale

CAMERA = Camera(200.0, 200.0, 127.5, 95.5, 256, 192)
NO_DEPTH = np.zeros((192, 256), np.float32)
SIDE_M = 0.16
# Poses that look at a marker 0.8 m away, from different sides.
VIEWS = [
    se3.exp(np.array([x, y, 0.0, 0.0, -x, 0.0]))
    for x, y in ((-0.15, 0.0), (-0.05, 0.05), (0.05, -0.05), (0.15, 0.02))
]


def corners(x: float = 0.0, side: float = SIDE_M) -> np.ndarray:
    """Corners [4, 3] of a marker that is turned towards nobody in particular."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side / 2
    T = se3.exp(np.array([x, 0.03, 0.8, 0.2, 0.1, 0.3]))
    return se3.transform_points(T, square)


def seen(number: int, points: np.ndarray, T: np.ndarray) -> MarkerView:
    px = CAMERA.project(se3.transform_points(se3.inverse(T), points))
    return MarkerView(number, T, px)


def picture(number: int, T: np.ndarray) -> np.ndarray:
    """Image [H, W, 3] of the marker on a white sheet."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36H11)
    marker = cv2.aruco.generateImageMarker(dictionary, number, 160)
    # Drawn four times as large. Pixels are areas around their centres.
    px = 4 * (seen(number, corners(), T).corners_px + 0.5) - 0.5
    outline = np.array([[0, 0], [160, 0], [160, 160], [0, 160]], np.float32) - 0.5
    H = cv2.getPerspectiveTransform(outline, px.astype(np.float32))
    border = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": 255}
    large = cv2.warpPerspective(marker, H, (4 * CAMERA.width, 4 * CAMERA.height), **border)
    grey = cv2.resize(large, CAMERA.size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    return np.repeat(grey[..., None], 3, axis=2)


def motion_at(poses: list[np.ndarray]) -> CameraMotion:
    """A motion whose keyframes are all frames."""
    views = [SweptKeyframe(n, T, 0.5, 2.0) for n, T in enumerate(poses)]
    trajectory = Trajectory(np.arange(len(poses)) / 30, np.array(poses))
    return CameraMotion(trajectory, CAMERA, views, len(poses), error_px=0.5)


def times(motion: CameraMotion) -> np.ndarray:
    return motion.trajectory.timestamps_s


def test_side_of_markers_by_their_projections():
    views = [seen(n, corners(x), T) for n, x in ((3, 0.0), (8, 0.2)) for T in VIEWS]
    side = side_length(views, CAMERA)
    assert side.length == pytest.approx(SIDE_M, rel=1e-9)
    assert side.markers == 2
    assert side.sigma < 1e-9


def test_noise_of_corners_appears_in_the_uncertainty():
    rng = np.random.default_rng(0)
    errors, sigmas = [], []
    for _ in range(40):
        views = [seen(3, corners(), T) for T in VIEWS]
        noisy = [replace(v, corners_px=v.corners_px + rng.normal(0, 0.5, (4, 2))) for v in views]
        side = side_length(noisy, CAMERA)
        errors.append(side.length / SIDE_M - 1)
        sigmas.append(side.sigma)
    assert 0.4 < np.std(errors) / np.sqrt(np.mean(np.square(sigmas))) < 2.5


@pytest.mark.parametrize(
    "views",
    [
        [],
        [seen(3, corners(), VIEWS[0])],
        # The same number at two places.
        [seen(3, corners(x), T) for x, T in zip((0.0, 0.3, 0.0, 0.3), VIEWS, strict=True)],
        # No parallax.
        [seen(3, corners(), VIEWS[0]), seen(3, corners(), VIEWS[0])],
    ],
)
def test_views_that_do_not_determine_a_marker_are_refused(views):
    assert side_length(views, CAMERA) is None


def test_markers_in_images_give_metres():
    frames = [Frame(n, n / 30, picture(5, T), NO_DEPTH, CAMERA) for n, T in enumerate(VIEWS)]
    found = detect_markers(frames[1].rgb, VIEWS[1], "apriltag-36h11")
    assert [view.marker for view in found] == [5]
    expected = seen(5, corners(), VIEWS[1]).corners_px
    np.testing.assert_allclose(found[0].corners_px, expected, atol=0.25)
    small = scaled(motion_at(VIEWS), 0.25)
    motion = with_metric_scale(small, Film(frames), times(small), ScaleOptions(marker_m=SIDE_M))
    assert motion.metric_scale.factor == pytest.approx(4.0, rel=0.005)
    np.testing.assert_allclose(motion.trajectory.positions_m, [T[:3, 3] for T in VIEWS], atol=0.005)
    assert motion.views[2].far == pytest.approx(2.0, rel=0.02)
    metrics = motion.metrics()
    assert metrics["metric_scale"] == motion.metric_scale.factor
    assert 0 < metrics["metric_scale_sigma_percent"] < 5
    assert "the metre, by the side of 1 marker(s)" in metrics["convention"]


def test_images_without_markers_leave_the_unit_arbitrary_and_raise_a_doubt():
    frames = [
        Frame(n, n / 30, np.full((192, 256, 3), 0.5, np.float32), NO_DEPTH, CAMERA)
        for n in range(4)
    ]
    before = motion_at(VIEWS)
    motion = with_metric_scale(before, Film(frames), times(before), ScaleOptions(marker_m=0.1))
    assert motion.metric_scale is None
    assert not motion.reliable
    assert "no apriltag-36h11 marker is seen" in motion.doubts[0]
    assert motion.metrics()["metric_scale"] is None
    assert motion.trajectory is before.trajectory


def test_a_known_distance_gives_metres():
    before = motion_at(VIEWS)
    options = ScaleOptions(distance_m=0.6, distance_frames=(0, 3))
    distance = np.linalg.norm(VIEWS[3][:3, 3] - VIEWS[0][:3, 3])
    motion = with_metric_scale(before, object(), times(before), options)
    assert motion.metric_scale.factor == pytest.approx(0.6 / distance)
    moved = motion.trajectory.positions_m
    assert np.linalg.norm(moved[3] - moved[0]) == pytest.approx(0.6)
    # Half a pixel at 1 m, of two positions.
    assert motion.metric_scale.sigma == pytest.approx(np.sqrt(2) * 0.5 / 200 / distance)


def test_a_distance_to_a_frame_without_pose_raises_a_doubt():
    before = motion_at(VIEWS)
    options = ScaleOptions(distance_m=0.6, distance_frames=(0, 4))
    motion = with_metric_scale(before, object(), np.arange(5) / 30, options)
    assert "a frame of the known distance has no pose" in motion.doubts[0]


def test_a_short_distance_is_too_uncertain():
    before = motion_at([VIEWS[0], VIEWS[0] @ se3.exp(np.array([0.005, 0, 0, 0, 0, 0.0]))])
    options = ScaleOptions(distance_m=0.6, distance_frames=(0, 1))
    motion = with_metric_scale(before, object(), times(before), options)
    assert "is uncertain by 71 %" in motion.doubts[0]


def room_points(rng: np.random.Generator, floor: int = 3000) -> np.ndarray:
    """Points of a floor 1.5 below the origin, a large table, walls, ceiling, and some below."""

    def plane(count: int, low: list[float], high: list[float]) -> np.ndarray:
        return rng.uniform(low, high, (count, 3)) + rng.normal(0, 0.01, (count, 3))

    return np.concatenate(
        [
            plane(floor, [-2, 1.5, 0], [2, 1.5, 4]),
            plane(4000, [-1, 0.75, 1], [1, 0.75, 3]),
            plane(6000, [-2, -1, 4], [2, 1.5, 4]),
            plane(5000, [-2, -1, 0], [2, -1, 4]),
            plane(60, [-2, 1.6, 0], [2, 3.0, 4]),
        ]
    )


@pytest.mark.parametrize("tilt_rad", [0.0, -0.5, 0.4])
def test_the_floor_is_the_lowest_large_surface(tilt_rad):
    rng = np.random.default_rng(1)
    cameras = np.array(
        [se3.exp(np.array([0.1 * n, 0.05 * (-1) ** n, 0, 0, 0, 0.0])) for n in range(6)]
    )
    turned = cameras @ se3.exp(np.array([0, 0, 0, tilt_rad, 0, 0.0]))
    # The world's axes are arbitrary.
    T = se3.exp(np.array([3.0, -1.0, 2.0, 0.7, -1.2, 0.4]))
    points = se3.transform_points(T, room_points(rng))
    height = height_above_floor(points, T @ turned, rng)
    assert height.height == pytest.approx(1.5, rel=0.01)
    assert height.sigma < 0.02


def test_without_a_floor_there_is_no_height():
    rng = np.random.default_rng(1)
    points = room_points(rng)
    walls = points[(points[:, 1] < 0.7) & (points[:, 1] > -0.9)]
    assert height_above_floor(walls, np.eye(4)[None], rng) is None
    assert height_above_floor(points[:2], np.eye(4)[None], rng) is None


def test_the_height_of_the_camera_gives_metres():
    """A walk whose camera looks down to the floor 1.2 m below the world's origin."""
    poses = walk(14) @ se3.exp(np.array([0, 0, 0, -0.6, 0, 0.0]))
    frames = film(poses)
    before = motion_of(frames)
    height_m = float(np.mean(1.2 - poses[:, 1, 3]))
    options = ScaleOptions(camera_height_m=height_m)
    motion = with_metric_scale(before, Film(frames), times(before), options)
    assert motion.reliable
    assert error_m(motion.trajectory, poses)[1] == pytest.approx(1.0, abs=0.04)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (ScaleOptions(marker_m=0.1, camera_height_m=1.5), "--scale.marker-m and --scale.camera"),
        (ScaleOptions(distance_m=1.0), "belong together"),
        (ScaleOptions(distance_frames=(0, 1)), "belong together"),
        (ScaleOptions(distance_m=1.0, distance_frames=(2, 2)), "two different frames"),
        (ScaleOptions(distance_m=1.0, distance_frames=(2, 9)), "frames below 9, got 2 9"),
    ],
)
def test_contradicting_options_are_refused(options, message):
    with pytest.raises(SettingsError, match=message):
        check_scale(options, 9)


def test_no_known_length_changes_nothing():
    before = motion_at(VIEWS)
    assert with_metric_scale(before, object(), times(before), ScaleOptions()) is before
