"""Simulation of the effects of a consumer RGB-D camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.synthetic_rooms.imperfections import (
    white_balance_gains,
    with_flying_pixels,
    without_reflections,
)
from toolkit.datasets.synthetic_rooms.ray_casting import RayCastView
from toolkit.datasets.synthetic_rooms.reflections import FARTHEST_M

# Structured-light camera: focal length 580 px at a width of 640, baseline 7.5 cm, disparity
# resolution 1/8 px.
_BASELINE_PIXELS_M = 580.0 * 0.075
_DISPARITY_STEP = 0.125
_NEAREST_M = 0.35


@dataclass(frozen=True)
class SensorModel:
    """Effects to simulate.

    Attributes:
        axial_noise: depth noise with sigma = 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2 (Nguyen 2012).
        quantisation: depth is quantised in steps of 1/8 pixel of disparity.
        holes: depth is missing at grazing angles, at depth edges and out of range.
        motion_blur: colour is averaged over 30 % of the time between frames.
        exposure_drift: the gain varies slowly by up to 8 %.
        colour_noise: standard deviation 1 % of white, independent per pixel and channel.
        label_noise: label borders are displaced and some blobs get a wrong class.
        white_balance: exposure and white balance change the gain of each channel smoothly.
        flying_pixels: depth beside depth edges lies between both surfaces.
        reflections: depth is missing on shiny objects at most angles.
    """

    axial_noise: bool = True
    quantisation: bool = True
    holes: bool = True
    motion_blur: bool = True
    exposure_drift: bool = True
    colour_noise: bool = True
    label_noise: bool = True
    white_balance: bool = False
    flying_pixels: bool = False
    reflections: bool = False

    @classmethod
    def of(cls, noise: bool, real: bool) -> SensorModel | None:
        """The effects of `semsplat make-room`, None for an ideal camera.

        Args:
            noise: those of `--sensor-noise`. real: those of `--real`.
        """
        if not noise and not real:
            return None
        return cls(
            axial_noise=noise,
            quantisation=noise,
            holes=True,
            motion_blur=noise,
            exposure_drift=noise,
            colour_noise=noise,
            label_noise=noise,
            white_balance=real,
            flying_pixels=real,
            reflections=real,
        )


class Sensor:
    """Applies a sensor model to the views of a sequence.

    Args:
        model: effects to simulate.
        camera: camera of all views.
        T_world_camera: [N, 4, 4] poses, which determine the motion during exposure.
        rng: source of randomness, from which each frame gets its own stream.
    """

    def __init__(
        self, model: SensorModel, camera: Camera, T_world_camera: NDArray, rng: np.random.Generator
    ) -> None:
        self._model = model
        self._camera = camera
        self._poses = np.asarray(T_world_camera, dtype=np.float64)
        self._phases = rng.uniform(0.0, 2 * math.pi, 2)
        *self._streams, slow = rng.spawn(len(self._poses) + 1)
        self._gains = white_balance_gains(len(self._poses), slow).astype(np.float32)

    def observe(self, index: int, view: RayCastView) -> RayCastView:
        """Apply the sensor model to the view of frame `index`."""
        model = self._model
        colour, depth, wrong, edges, shine = self._streams[index].spawn(5)
        rgb, depth_m, labels = view.rgb, view.depth_m, view.labels
        if model.motion_blur:
            rgb = _motion_blurred(rgb, depth_m, self._camera, self._motion(index))
        if model.exposure_drift:
            rgb = rgb * self._gain(index)
        if model.white_balance:
            rgb = rgb * self._gains[index]
        if model.colour_noise:
            rgb = rgb + 0.01 * colour.standard_normal(rgb.shape, dtype=np.float32)
        if model.axial_noise:
            depth_m = _noisy(depth_m, depth)
        if model.quantisation:
            depth_m = _quantised(depth_m)
        if model.holes:
            depth_m = _with_holes(depth_m, view, depth)
        if model.flying_pixels:
            depth_m = with_flying_pixels(depth_m, view.depth_m, edges)
        if model.reflections:
            depth_m = without_reflections(depth_m, view.labels, view.cosine, shine)
        if model.label_noise:
            labels = _wrong_labels(labels, wrong)
        rgb = np.clip(rgb, 0.0, 1.0).astype(np.float32)
        return replace(view, rgb=rgb, depth_m=depth_m.astype(np.float32), labels=labels)

    def _motion(self, index: int) -> NDArray[np.float64]:
        """Return T_next_now [4, 4] to the next frame; the last one repeats the previous motion."""
        last = len(self._poses) - 1
        now = max(0, min(index, last - 1))
        return se3.inverse(self._poses[min(now + 1, last)]) @ self._poses[now]

    def _gain(self, index: int) -> float:
        slow, fast = index / 90.0, index / 31.0
        first, second = self._phases
        return (
            1.0
            + 0.05 * math.sin(2 * math.pi * slow + first)
            + 0.03 * math.sin(2 * math.pi * fast + second)
        )


def _motion_blurred(
    rgb: NDArray, depth_m: NDArray, camera: Camera, T_next_now: NDArray
) -> NDArray[np.floating]:
    """Average the image along its optical flow over 30 % of the frame time.

    The image is warped by its flow instead of being rendered at several times. This differs only
    at disocclusions and is much faster.
    """
    points = se3.transform_points(T_next_now, camera.unproject(depth_m))
    points[..., 2] = np.maximum(points[..., 2], 1e-3)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    here = np.stack([x, y], axis=-1)
    flow = np.where(depth_m[..., None] > 0, camera.project(points) - here, 0.0)
    total = np.zeros(rgb.shape, dtype=np.float32)
    moments = np.linspace(-0.15, 0.15, 5)
    for moment in moments:
        place = (here + moment * flow).astype(np.float32)
        total += cv2.remap(rgb, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / np.float32(len(moments))


def _noisy(depth_m: NDArray, rng: np.random.Generator) -> NDArray[np.floating]:
    sigma = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    noisy = depth_m + sigma * rng.standard_normal(depth_m.shape, dtype=np.float32)
    return np.where(depth_m > 0, noisy, 0.0)


def _quantised(depth_m: NDArray) -> NDArray[np.floating]:
    disparity = _BASELINE_PIXELS_M / np.maximum(depth_m, 0.05)
    steps = np.maximum(np.round(disparity / _DISPARITY_STEP), 1.0)
    return np.where(depth_m > 0, _BASELINE_PIXELS_M / (steps * _DISPARITY_STEP), 0.0)


def _with_holes(
    depth_m: NDArray, view: RayCastView, rng: np.random.Generator
) -> NDArray[np.floating]:
    """Remove depth on slanted surfaces, irregularly at depth edges, and out of range."""
    chance = rng.random(depth_m.shape, dtype=np.float32)
    # The fraction of pixels with depth decreases from 75 degrees and is zero beyond 84.
    grazing = view.cosine < 0.1 + 0.16 * chance
    true = view.depth_m
    kernel = np.ones((3, 3), dtype=np.uint8)
    nearest, farthest = cv2.erode(true, kernel), cv2.dilate(true, kernel)
    edge = (farthest - nearest > 0.04 + 0.03 * nearest) & (chance < 0.8)
    out_of_range = (depth_m < _NEAREST_M) | (depth_m > FARTHEST_M)
    return np.where(grazing | edge | out_of_range, 0.0, depth_m)


def _wrong_labels(labels: NDArray, rng: np.random.Generator) -> NDArray[np.int32]:
    height, width = labels.shape
    # Displace borders smoothly by about one pixel at a width of 320.
    coarse = rng.standard_normal((2, max(2, height // 12), max(2, width // 12)))
    shift = [
        cv2.resize(plane.astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
        for plane in coarse * (1.2 * width / 320)
    ]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    wandered = cv2.remap(
        labels.astype(np.float32), x + shift[0], y + shift[1], cv2.INTER_NEAREST,
        borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    out = wandered.astype(np.int32)
    present = np.unique(out)
    for _ in range(rng.poisson(2.0)):
        centre = rng.uniform([0, 0], [width, height])
        radius = rng.uniform(0.015, 0.05) * width
        blob = (x - centre[0]) ** 2 + (y - centre[1]) ** 2 < radius**2
        out[blob] = rng.choice(present)
    return out
