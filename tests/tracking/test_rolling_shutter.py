"""Rolling shutter: images are resampled as if all rows had been exposed at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.slam.tracking.rolling_shutter import (
    as_exposed,
    rectified,
    steady_velocity,
    velocity_between,
)

CAMERA = Camera(130.0, 128.0, 80.0, 58.0, 160, 120)
READOUT_S = 0.03
# Half a metre and sixty degrees per second.
VELOCITY = np.array([0.3, -0.2, 0.35, -0.7, 0.6, 0.5])
# n . X = 1: a slanted wall two metres away, in the frame of the middle row.
WALL = np.array([0.08, -0.1, 0.5])


def wall(times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of a wall, from a camera with a time for each row."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1
    )
    poses = np.array([se3.exp(t * VELOCITY) for t in times_s])
    directions = np.einsum("vij,vuj->vui", poses[:, :3, :3], rays)
    centres = poses[:, None, :3, 3]
    depth_m = (1.0 - centres @ WALL) / (directions @ WALL)
    points = centres + depth_m[..., None] * directions
    rgb = 0.5 + 0.4 * np.sin(points @ np.array([[7.0, 3.0, 9.0], [5.0, 8.0, -4.0], [1, 2, 3]]))
    return rgb.astype(np.float32), depth_m.astype(np.float32)


def observed(readout_s: float = READOUT_S) -> Frame:
    """A frame with a rolling shutter."""
    rgb, depth_m = wall(readout_s * ((np.arange(CAMERA.height) + 0.5) / CAMERA.height - 0.5))
    return Frame(3, 0.1, rgb, depth_m, CAMERA, readout_s=readout_s)


def differences(rgb, depth_m, other_rgb, other_depth_m) -> tuple[float, float]:
    """RMS difference of colour, and mean difference of depth where both have it (m)."""
    inside = (slice(8, -8), slice(8, -8))
    seen = (depth_m > 0) & (other_depth_m > 0)
    assert seen[inside].all()
    colour = np.sqrt(np.mean((rgb - other_rgb)[inside] ** 2))
    return float(colour), float(np.abs(depth_m - other_depth_m)[seen].mean())


def test_a_frame_looks_as_if_all_rows_were_exposed_with_the_middle_one():
    truth, frame = wall(np.zeros(CAMERA.height)), observed()
    found = rectified(frame, VELOCITY)
    before = differences(frame.rgb, frame.depth_m, *truth)
    after = differences(found.rgb, found.depth_m, *truth)
    assert found.readout_s == 0.0
    assert after[0] < 0.05 * before[0]
    assert after[1] < 0.3 * before[1] and after[1] < 2e-3  # depth is that of the nearest pixel


def test_a_rendering_is_exposed_as_the_sensor_would_have():
    frame = observed()
    rgb, depth_m = as_exposed(*wall(np.zeros(CAMERA.height)), frame, VELOCITY)
    colour, depth = differences(rgb, depth_m, frame.rgb, frame.depth_m)
    assert colour < 0.005 and depth < 2e-3


def test_rotation_is_undone_without_any_depth():
    frame = replace(observed(), depth_m=np.zeros((120, 160), np.float32))
    turning = np.concatenate([np.zeros(3), VELOCITY[3:]])
    truth = wall(np.zeros(CAMERA.height))[0]
    found = rectified(frame, turning)
    assert not found.depth_m.any()
    assert np.abs(found.rgb - truth).mean() < 0.5 * np.abs(frame.rgb - truth).mean()


def test_labels_and_inferred_depth_move_with_the_images():
    frame = observed()
    left = np.broadcast_to(np.arange(160) < 80, (120, 160))
    marked = replace(frame, labels=left.astype(np.int32), inferred=left.copy(), ignored=left)
    found = rectified(marked, VELOCITY)
    assert np.array_equal(found.labels == 1, found.inferred)
    assert np.array_equal(found.ignored, found.inferred)
    moved = found.inferred != left
    assert 0 < moved.mean() < 0.05
    assert np.array_equal(found.rgb, rectified(frame, VELOCITY).rgb)


@pytest.mark.parametrize(
    ("readout_s", "velocity"),
    [
        (0.0, VELOCITY),  # a global shutter
        (READOUT_S, None),
        (READOUT_S, 1e-3 * VELOCITY),
        (READOUT_S, 20.0 * VELOCITY),  # nobody moves like that: tracking failed
    ],
)
def test_images_that_need_not_or_cannot_be_resampled_are_kept(readout_s, velocity):
    frame = replace(observed(), readout_s=readout_s)
    found = rectified(frame, velocity)
    assert found.rgb is frame.rgb and found.depth_m is frame.depth_m
    assert found.readout_s == 0.0
    rgb, depth_m = as_exposed(frame.rgb, frame.depth_m, frame, velocity)
    assert rgb is frame.rgb and depth_m is frame.depth_m


def test_the_velocity_is_that_of_the_camera_in_its_own_frame():
    first = se3.exp(np.array([1.0, 2.0, 3.0, 0.4, -0.2, 0.9]))
    found = velocity_between(first, first @ se3.exp(0.1 * VELOCITY), 0.1)
    np.testing.assert_allclose(found, VELOCITY, atol=1e-9)


@pytest.mark.parametrize("period_s", [1 / 60, 1 / 30, 1 / 10])
def test_a_steady_velocity_is_known(period_s):
    times_s = period_s * np.arange(3)
    poses = [se3.exp(t * VELOCITY) for t in times_s]
    np.testing.assert_allclose(steady_velocity(poses, times_s), VELOCITY, atol=1e-9)


@pytest.mark.parametrize(
    ("times_s", "taken_s"),
    [
        ([0.0], [0.0]),
        ([0.0, 0.2, 0.4], [0.0, 0.2, 0.4]),  # few frames per second
        ([0.0, 0.03, 0.2], [0.0, 0.03, 0.2]),  # frames were dropped
        ([0.0, 0.03, 0.06], [0.0, 0.03, 0.03]),  # an image was delivered twice
        ([0.0, 0.03, 0.06], [0.0, 0.0, 0.03]),
    ],
)
def test_other_velocities_are_not_known(times_s, taken_s):
    poses = [se3.exp(t * VELOCITY) for t in taken_s]
    assert steady_velocity(poses, times_s) is None
