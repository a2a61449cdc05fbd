"""Data types of dense alignment: pyramid levels, residual scales, normal equations, estimates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import (
    MAX_DEPTH_SCALE,
    MAX_INTENSITY_SCALE,
    MIN_DEPTH_SCALE,
    MIN_INTENSITY_SCALE,
)

# A numpy image [H, W] or [H, W, C] of one level.
Image = NDArray[np.float32]


@dataclass(frozen=True)
class FrameLevel:
    """One pyramid level of a frame.

    Attributes:
        camera: intrinsics of this level's images.
        intensity: [H, W] float32 in [0, 1].
        depth_m: [H, W] float32 z-depth in metres, 0 where missing.

    Raises:
        ValueError: an image does not have the camera's size.
    """

    camera: Camera
    intensity: Tensor
    depth_m: Tensor

    def __post_init__(self) -> None:
        for name in ("intensity", "depth_m"):
            _check_shape(name, getattr(self, name), (self.camera.height, self.camera.width))


@dataclass(frozen=True)
class ModelLevel:
    """One pyramid level of the view that frames are aligned to.

    Attributes:
        camera: intrinsics of this level's images.
        texture: [H, W, 4] float32 intensity, its x and y derivatives per pixel, depth (m); all 0
            where unusable.
        surface: [H, W, 4] float32 unit normal in the view's frame and plane offset (m); all 0
            where unusable.

    Raises:
        ValueError: an image does not have the camera's size.
    """

    camera: Camera
    texture: Tensor
    surface: Tensor

    def __post_init__(self) -> None:
        for name in ("texture", "surface"):
            _check_shape(name, getattr(self, name), (self.camera.height, self.camera.width, 4))


def _check_shape(name: str, image: Tensor, expected: tuple[int, ...]) -> None:
    """Reject an image whose size is not its camera's: kernels index it by the camera's size."""
    if image.shape != expected:
        raise ValueError(f"{name} must have shape {list(expected)}, got {list(image.shape)}")


@dataclass(frozen=True)
class ResidualScales:
    """Standard deviations of the residuals.

    Attributes:
        intensity: of the photometric residual, for intensities in [0, 1].
        depth_m: of the point-to-plane residual at a depth of 1 m, in metres. The sensor's noise
            grows with the squared depth.
        photometric_weight: weight of the photometric term relative to the geometric term.
    """

    intensity: float
    depth_m: float
    photometric_weight: float = 1.0


@dataclass(frozen=True)
class LevelProblem:
    """Alignment of a frame to a model at one pyramid level, at a pose. Their cameras may differ.

    Attributes:
        model, frame: the level of each, on one device.
        T_model_frame: [4, 4] float64.
        scales: of the residuals.
        exposure: of the frame against the model.
        max_distance: maximum depth difference of corresponding pixels, as a fraction of depth.
    """

    model: ModelLevel
    frame: FrameLevel
    T_model_frame: NDArray[np.float64]
    scales: ResidualScales
    exposure: Exposure
    max_distance: float

    @property
    def parameters(self) -> tuple[float, float, float, float, float, float]:
        """Gain, bias, both scales, maximum distance and photometric weight, as kernels expect."""
        exposure, scales = self.exposure, self.scales
        sigmas = scales.intensity, scales.depth_m
        weight = scales.photometric_weight
        return (exposure.gain, exposure.bias, *sigmas, self.max_distance, weight)


# Initial scales, and the range of the re-estimated ones.
INITIAL_SCALES = ResidualScales(intensity=0.05, depth_m=0.01)
MIN_SCALES = ResidualScales(MIN_INTENSITY_SCALE, MIN_DEPTH_SCALE)
MAX_SCALES = ResidualScales(MAX_INTENSITY_SCALE, MAX_DEPTH_SCALE)


def _triangle_index() -> NDArray[np.intp]:
    """Index [8, 8] of each entry of a symmetric matrix in its upper triangle [36], row by row."""
    index = np.zeros((8, 8), np.intp)
    rows, columns = np.triu_indices(8)
    index[rows, columns] = index[columns, rows] = np.arange(len(rows))
    return index


_TRIANGLE_INDEX = _triangle_index()


@dataclass(frozen=True)
class Linearisation:
    """Normal equations at a pose, and statistics of the residuals.

    Attributes:
        H: [8, 8] float64 over (translation, rotation, gain, bias). g: [8] float64.
        intensity_pixels, depth_pixels: number of photometric and of geometric residuals.
        intensity_variance, depth_variance: robust mean squared residuals in units of the scales.
        frame_pixels: number of frame pixels with depth that project into the model's image.
    """

    H: NDArray[np.float64]
    g: NDArray[np.float64]
    intensity_pixels: float
    depth_pixels: float
    intensity_variance: float
    depth_variance: float
    frame_pixels: float

    @classmethod
    def from_sums(cls, sums: NDArray[np.float64]) -> Linearisation:
        """Unpack the sums [49] of the native and numpy kernels.

        They are the upper triangle of H row by row, g, the numbers of photometric and geometric
        residuals, their weighted sums of squares, and the number of frame pixels.
        """
        return cls.from_squares(sums[_TRIANGLE_INDEX], sums[36:44].copy(), sums[44:49])

    @classmethod
    def from_squares(
        cls, H: NDArray[np.float64], g: NDArray[np.float64], counts: NDArray[np.float64]
    ) -> Linearisation:
        """Normal equations with the five counts of `from_sums`."""
        intensity_pixels, depth_pixels, intensity_squares, depth_squares, frame_pixels = (
            float(count) for count in counts
        )
        return cls(
            H=H,
            g=g,
            intensity_pixels=intensity_pixels,
            depth_pixels=depth_pixels,
            intensity_variance=intensity_squares / max(intensity_pixels, 1.0),
            depth_variance=depth_squares / max(depth_pixels, 1.0),
            frame_pixels=frame_pixels,
        )

    @property
    def cost(self) -> float:
        """Mean robust squared residual; comparable between poses at equal scales."""
        pixels = self.intensity_pixels + self.depth_pixels
        if pixels < 1:
            return float("inf")
        total = self.intensity_variance * self.intensity_pixels
        total += self.depth_variance * self.depth_pixels
        return total / pixels


def rescaled(scales: ResidualScales, linear: Linearisation) -> ResidualScales:
    """Re-estimate the scales of Student's t distribution: one fixed-point iteration."""
    intensity, depth_m = scales.intensity, scales.depth_m
    if linear.intensity_pixels:
        intensity *= math.sqrt(linear.intensity_variance)
        intensity = min(max(intensity, MIN_SCALES.intensity), MAX_SCALES.intensity)
    if linear.depth_pixels:
        depth_m *= math.sqrt(linear.depth_variance)
        depth_m = min(max(depth_m, MIN_SCALES.depth_m), MAX_SCALES.depth_m)
    return replace(scales, intensity=intensity, depth_m=depth_m)


@dataclass(frozen=True)
class GaussNewtonOptions:
    """Parameters of one frame's alignment.

    Attributes:
        iterations: maximum number of iterations per pyramid level.
        max_distance: maximum depth difference of corresponding pixels at the finest level, as a
            fraction of depth; doubled at every coarser level.
        photometric_weight: weight of the photometric term relative to the geometric term.
        exposure: exposure of the previous frame, or None to keep the exposure fixed. Only
            the finest level adjusts it: at coarser levels the estimate may be far from the
            solution, and the pose is fitted at the previous exposure.
        min_pixels: minimum number of residuals.
        min_translation_m, min_rotation_rad: a smaller step ends the finest level. The thresholds
            are four times as large at every coarser level. By default, a thousandth of a pixel at
            usual focal lengths.
    """

    iterations: int
    max_distance: float
    photometric_weight: float
    exposure: Exposure | None
    min_pixels: int = 50
    min_translation_m: float = 2e-5
    min_rotation_rad: float = 1e-5


@dataclass(frozen=True)
class Alignment:
    """The estimate of one frame's alignment to one view.

    Attributes:
        T_view_camera: [4, 4] float64.
        scales: of the residuals.
        exposure: of the frame against the view.
        iterations: number of iterations so far.
        converged: whether the last step at the finest level was small.
        last: normal equations of the last iteration, or None before the first.
    """

    T_view_camera: NDArray[np.float64]
    scales: ResidualScales
    exposure: Exposure = IDENTITY
    iterations: int = 0
    converged: bool = False
    last: Linearisation | None = None
