"""Rolling shutter: the rows of an image are exposed one after another, while the camera moves.

Kinects, webcams and phones expose their last row about as late as the first row of the next image.
In a turn of 60 degrees per second, that shifts the top of an image of 640 pixels against its bottom
by more than ten pixels. Surfaces measured in such a turn are bent, and views of the same place from
different turns contradict each other.

The pose of a frame is that of its middle row. From the velocity of the camera, images are resampled
as if all rows had been exposed at that time. Within a row, the scene is approximated by the plane
that fits the inverse depth of the image: the translation during a readout moves pixels by at most a
few pixels, and colour and depth must be moved alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# Frames that are farther apart in time (seconds) do not give the velocity of a hand.
MAX_GAP_S = 0.11
# Minimum speed from frame to frame, relative to the largest one.
_MIN_SPEED = 0.3
# Smaller displacements (pixels) are not worth the resampling.
_MIN_DISPLACEMENT = 0.5
# Larger displacements, as a fraction of the image's height, follow from wrong velocities.
_MAX_DISPLACEMENT = 0.15
# Every n-th row and column is used to fit the plane.
_STEP = 8
_MIN_SAMPLES = 30


def rectified(frame: Frame, velocity: Array | None) -> Frame:
    """Resample a frame as if all rows had been exposed with the middle one.

    Args:
        frame: with `readout_s`, the time from the exposure of the first row to that of the last.
        velocity: [6] m/s and rad/s of the camera in its own frame; None if it is not known.

    Returns:
        The frame with a `readout_s` of 0. Pixels that the sensor did not see have no depth. The
        images are those of the frame if the camera hardly moves or its velocity is unlikely.
    """
    still = replace(frame, readout_s=0.0)
    if velocity is None or frame.readout_s == 0.0:
        return still
    motion = _Motion.of(frame.camera, frame.readout_s, velocity, frame.depth_m)
    # The time at which a pixel was exposed is that of its row in the observed image.
    times_s = motion.row_times_s(motion.rows(-motion.row_times_s()))
    if not motion.matters(times_s):
        return still
    map_x, map_y = motion.maps(-times_s)
    depth_m = _nearest(frame.depth_m, map_x, map_y)
    return replace(
        still,
        rgb=_smooth(frame.rgb, map_x, map_y),
        depth_m=motion.carried(depth_m, times_s, map_x, map_y),
        labels=None if frame.labels is None else _nearest(frame.labels, map_x, map_y),
        inferred=_nearest_mask(frame.inferred, map_x, map_y),
        ignored=_nearest_mask(frame.ignored, map_x, map_y),
    )


def as_exposed(
    rgb: Image, depth_m: Image, frame: Frame, velocity: Array | None
) -> tuple[Image, Image]:
    """Resample a rendering as a camera with a rolling shutter would have seen it.

    Args:
        rgb, depth_m: [H, W, 3] in [0, 1] and [H, W] in metres, rendered at the pose of the frame.
        frame: the frame, with its `readout_s`.
        velocity: as in `rectified`.
    """
    if velocity is None or frame.readout_s == 0.0:
        return rgb, depth_m
    motion = _Motion.of(frame.camera, frame.readout_s, velocity, depth_m)
    times_s = motion.row_times_s()
    if not motion.matters(times_s):
        return rgb, depth_m
    map_x, map_y = motion.maps(times_s)
    seen = _nearest(depth_m, map_x, map_y)
    return _smooth(rgb, map_x, map_y), motion.carried(seen, -times_s, map_x, map_y)


def velocity_between(T_world_first: Array, T_world_second: Array, elapsed_s: float) -> Array:
    """Velocity [6] (m/s, rad/s) of a camera in its own frame, from two of its poses [4, 4]."""
    return se3.log(se3.inverse(T_world_first) @ T_world_second) / elapsed_s


def steady_velocity(poses: Sequence[Array], times_s: Sequence[float]) -> Array | None:
    """Mean velocity [6] over neighbouring poses [4, 4] of a camera, in the frame of the first.

    Returns:
        None if it is not known: there are less than two poses, they are far apart in time, or the
        camera hardly moved between two of them only, as if an image had been delivered twice.
    """
    if len(poses) < 2 or max(np.diff(times_s)) > MAX_GAP_S:
        return None
    steps = [
        velocity_between(poses[n], poses[n + 1], times_s[n + 1] - times_s[n])
        for n in range(len(poses) - 1)
    ]
    speeds = [float(np.linalg.norm(step)) for step in steps]
    if min(speeds) < _MIN_SPEED * max(speeds):
        return None
    return velocity_between(poses[0], poses[-1], times_s[-1] - times_s[0])


@dataclass(frozen=True, eq=False)
class _Motion:
    """Motion of the rays of a camera while an image is read out.

    Attributes:
        readout_s: from the first row to the last.
        velocity: [6] of the camera.
        rates: [3, 3] derivative of a ray (x, y, 1) from the pose of the middle row, per second.
    """

    camera: Camera
    readout_s: float
    velocity: Array
    rates: Array

    @classmethod
    def of(cls, camera: Camera, readout_s: float, velocity: Array, depth_m: Image) -> _Motion:
        plane = _inverse_depth_plane(camera, depth_m)
        rates = se3.hat(velocity[3:]) + np.outer(velocity[:3], plane)
        return cls(camera, readout_s, velocity, rates)

    def row_times_s(self, rows: Array | None = None) -> Array:
        """Times [H] of the exposure of rows; by default, of all rows of the image."""
        height = self.camera.height
        exposed = np.arange(height, dtype=np.float64) if rows is None else rows
        return np.asarray(self.readout_s * ((exposed + 0.5) / height - 0.5))

    def rows(self, times_s: Array) -> Array:
        """Rows [H] at which the middle pixels of the rows are seen, one time for each."""
        rays = self._rays(times_s)[0]
        return self.camera.fy * rays[:, 1] / rays[:, 2] + self.camera.cy

    def matters(self, times_s: Array) -> bool:
        """Whether the motion displaces pixels, and by a likely amount."""
        start, slope = self._rays(times_s)
        middle = self._rays(np.zeros_like(times_s))
        moved = start - middle[0]
        height, width = self.camera.height, self.camera.width
        edge = max(self.camera.cx, width - self.camera.cx) / self.camera.fx
        moved = np.abs(moved) + edge * np.abs(slope - middle[1])
        largest = self.camera.focal * float(np.linalg.norm(moved, axis=1).max())
        return _MIN_DISPLACEMENT < largest < _MAX_DISPLACEMENT * height

    def maps(self, times_s: Array) -> tuple[Image, Image]:
        """Columns and rows [H, W] at which the pixels are seen, one time [H] for each row."""
        camera = self.camera
        start, slope = (a.astype(np.float32) for a in self._rays(times_s))
        x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
        right, down, forward = (
            start[:, axis, None] + slope[:, axis, None] * x for axis in range(3)
        )
        map_x = np.float32(camera.fx) * right / forward + np.float32(camera.cx)
        map_y = np.float32(camera.fy) * down / forward + np.float32(camera.cy)
        return map_x.astype(np.float32), map_y.astype(np.float32)

    def carried(self, depth_m: Image, times_s: Array, map_x: Image, map_y: Image) -> Image:
        """Depth [H, W] of points after a time for each row, 0 where missing.

        Args:
            depth_m: [H, W] before that time, resampled with the maps.
        """
        camera, times = self.camera, times_s.astype(np.float32)[:, None]
        turn_x, turn_y = (np.float32(self.velocity[3 + axis]) for axis in (0, 1))
        x, y = (map_x - camera.cx) / camera.fx, (map_y - camera.cy) / camera.fy
        moved = depth_m + times * (depth_m * (turn_x * y - turn_y * x) + self.velocity[2])
        return np.where((depth_m > 0) & (moved > 0), moved, 0.0).astype(np.float32)

    def _rays(self, times_s: Array) -> tuple[Array, Array]:
        """Rays [H, 3] of the middle column, and their change [H, 3] per unit of x."""
        y = (np.arange(self.camera.height) - self.camera.cy) / self.camera.fy
        matrices = np.eye(3) + times_s[:, None, None] * self.rates
        return matrices[:, :, 1] * y[:, None] + matrices[:, :, 2], matrices[:, :, 0]


def _inverse_depth_plane(camera: Camera, depth_m: Image) -> Array:
    """Coefficients [3] of the plane whose inverse depth (1 / m) on a ray is their product."""
    rows, columns = np.nonzero(depth_m[::_STEP, ::_STEP] > 0)
    if len(rows) < _MIN_SAMPLES:
        return np.zeros(3)
    x = (_STEP * columns - camera.cx) / camera.fx
    y = (_STEP * rows - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], axis=1)
    inverse = 1.0 / depth_m[_STEP * rows, _STEP * columns].astype(np.float64)
    plane, *_ = np.linalg.lstsq(rays, inverse, rcond=None)
    return np.asarray(plane)


def _smooth(image: Image, map_x: Image, map_y: Image) -> Image:
    found = np.asarray(
        cv2.remap(image, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    )
    return np.clip(found, 0.0, 1.0, out=found)  # cubic interpolation overshoots at edges


def _nearest_mask(
    mask: NDArray[np.bool_] | None, map_x: Image, map_y: Image
) -> NDArray[np.bool_] | None:
    return None if mask is None else _nearest(mask.astype(np.uint8), map_x, map_y).astype(np.bool_)


def _nearest(image: NDArray, map_x: Image, map_y: Image) -> NDArray:
    found = cv2.remap(image, map_x, map_y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(found)
