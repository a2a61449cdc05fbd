"""Dense alignment of a frame to a rendered view: pyramids and Gauss-Newton sums.

The work is done by the native kernels, or by the same equations in numpy where none were
compiled; on a GPU by torch and Triton. They agree and are tested against each other.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.frame import Frame
from toolkit.geometry.camera import Camera
from toolkit.native import address, kernels_for
from toolkit.rendering.surface import EDGE, SurfaceView
from toolkit.rendering.texture import centred_intensity, moved_to_centres
from toolkit.tracking import alignment_numpy, alignment_torch

LUMA = (0.299, 0.587, 0.114)
_SUMS = 49  # doubles of the kernel's result


@dataclass(frozen=True)
class FrameLevel:
    """One pyramid level of a frame: intensity [H, W] in [0, 1], depth [H, W] in metres.

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
    """One pyramid level of a rendered view.

    Attributes:
        texture: [H, W, 4] intensity, its x and y derivatives, depth (m); 0 where unusable.
        surface: [H, W, 4] unit normal in the view's frame and plane offset; 0 where unusable.

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
    """Refuse an image that is not its camera's: kernels read it by the camera's size."""
    if image.shape != expected:
        raise ValueError(f"{name} must have shape {list(expected)}, got {list(image.shape)}")


@dataclass(frozen=True)
class Scales:
    """What a residual of one standard deviation is.

    Attributes:
        intensity: photometric, intensities in [0, 1].
        depth_m: point to plane at 1 m; the sensor's noise grows with the squared depth.
        photometric_weight: of photometric residuals against geometric ones, once scaled.
    """

    intensity: float
    depth_m: float
    photometric_weight: float = 1.0


# Start and bounds of the scales, which every step re-estimates.
START_SCALES = Scales(intensity=0.05, depth_m=0.01)
LEAST_SCALES = Scales(intensity=0.002, depth_m=0.0001)
MOST_SCALES = Scales(intensity=0.2, depth_m=0.05)


@dataclass(frozen=True)
class Linearisation:
    """Normal equations at a pose and the numbers that judge it.

    Attributes:
        H: [8, 8] over (translation, rotation, gain, bias). g: [8].
        intensity_pixels, depth_pixels: residuals that took part.
        intensity_variance, depth_variance: weighted mean squares in units of the scales.
        frame_pixels: measured frame pixels that fall into the view.
    """

    H: NDArray[np.float64]
    g: NDArray[np.float64]
    intensity_pixels: float
    depth_pixels: float
    intensity_variance: float
    depth_variance: float
    frame_pixels: float

    @property
    def cost(self) -> float:
        """Mean robust squared residual, comparable between poses at equal scales."""
        pixels = self.intensity_pixels + self.depth_pixels
        if pixels < 1:
            return float("inf")
        total = self.intensity_variance * self.intensity_pixels
        total += self.depth_variance * self.depth_pixels
        return total / pixels


def finest_level(frame: Frame, device: torch.device) -> FrameLevel:
    """A frame's own size, on a device."""
    intensity, depth_m = intensity_of(frame.rgb), torch.from_numpy(frame.depth_m)
    return FrameLevel(frame.camera, _brought(intensity, device), _brought(depth_m, device))


def _brought(image: Tensor, device: torch.device) -> Tensor:
    """An image of the CPU's on a device; from pinned memory the copy waits for nobody."""
    if device.type != "cuda":
        return image.to(device)
    return image.pin_memory().to(device, non_blocking=True)


def intensity_of(rgb: NDArray[np.float32]) -> Tensor:
    """Luma [H, W] of an RGB image [H, W, 3]."""
    weights = np.array(LUMA, dtype=np.float32)
    return torch.from_numpy(np.ascontiguousarray(rgb @ weights))


def halved(level: FrameLevel, halvings: int = 0) -> FrameLevel:
    """The next level: intensity and depth of the nearest surface in each 2x2 cell.

    Args:
        halvings: of the level itself; so many times farther apart are the rays of its pixels,
            and so much more depth may differ on a surface.
    """
    camera, edge = level.camera.halved(), EDGE * 2**halvings
    if level.depth_m.device.type != "cpu":
        return FrameLevel(camera, *alignment_torch.halve(level.intensity, level.depth_m, edge))
    module = kernels_for(level.depth_m)
    if module is None:
        intensity, depth = alignment_numpy.halve(
            level.intensity.numpy(), level.depth_m.numpy(), edge
        )
        return FrameLevel(camera, torch.from_numpy(intensity), torch.from_numpy(depth))
    half = FrameLevel(
        camera,
        torch.empty(camera.height, camera.width),
        torch.empty(camera.height, camera.width),
    )
    module.align_halve(
        level.camera.size,
        address(level.intensity),
        address(level.depth_m),
        edge,
        address(half.intensity),
        address(half.depth_m),
    )
    return half


def pyramid(level: FrameLevel, levels: int) -> list[FrameLevel]:
    """Levels from fine to coarse."""
    out = [level]
    while len(out) < levels:
        out.append(halved(out[-1], halvings=len(out) - 1))
    return out


def view_of(surface: SurfaceView, least_silhouette: float, centred: bool = True) -> FrameLevel:
    """Intensity and surface depth of a drawn view, 0 where it is too thin.

    Args:
        centred: colours of the map belong to its Gaussians' centres, as mapping fits them; those
            of a refined map belong to the pixels.
    """
    intensity = centred_intensity(surface, least_silhouette) if centred else None
    if intensity is None:
        intensity = _intensity_as_drawn(surface, least_silhouette)
        if centred:
            intensity = moved_to_centres(intensity, surface, least_silhouette)
    return FrameLevel(surface.camera, intensity, surface.depth_m)


def _intensity_as_drawn(surface: SurfaceView, least_silhouette: float) -> Tensor:
    images, camera = surface.images, surface.camera
    if images.device.type != "cpu":
        return alignment_torch.intensity_of(images, least_silhouette)
    module = kernels_for(images)
    if module is None:
        return torch.from_numpy(alignment_numpy.intensity_of(images.numpy(), least_silhouette))
    intensity = torch.empty(camera.height, camera.width)
    module.align_intensity(camera.size, address(images), least_silhouette, address(intensity))
    return intensity


def model_level(level: FrameLevel) -> ModelLevel:
    """Derivatives and planes of one level of a rendered view."""
    camera = level.camera
    if level.depth_m.device.type != "cpu":
        return ModelLevel(camera, *alignment_torch.model(camera, level.intensity, level.depth_m))
    module = kernels_for(level.depth_m)
    if module is None:
        texture, surface = alignment_numpy.model(
            camera, level.intensity.numpy(), level.depth_m.numpy()
        )
        return ModelLevel(camera, torch.from_numpy(texture), torch.from_numpy(surface))
    model = ModelLevel(
        camera,
        torch.empty(camera.height, camera.width, 4),
        torch.empty(camera.height, camera.width, 4),
    )
    module.align_level(
        (camera.fx, camera.fy, camera.cx, camera.cy),
        camera.size,
        address(level.intensity),
        address(level.depth_m),
        address(model.texture),
        address(model.surface),
    )
    return model


def linearise(
    model: ModelLevel,
    frame: FrameLevel,
    T_model_frame: NDArray[np.float64],
    scales: Scales,
    exposure: tuple[float, float],
    max_distance: float,
) -> Linearisation:
    """Normal equations of frame against model at a pose; their cameras may differ.

    Args:
        T_model_frame: [4, 4]; the perturbation multiplies from the left.
        exposure: (gain, bias), frame intensity to model intensity.
        max_distance: gate on depth differences, as a share of the depth.
    """
    sigmas = scales.intensity, scales.depth_m
    scalars = (*exposure, *sigmas, max_distance, scales.photometric_weight)
    cameras = model.camera, frame.camera
    if frame.depth_m.is_cuda:
        from toolkit.tracking.cuda.aligner import linearised

        return linearised(model, frame, T_model_frame, scales, exposure, max_distance)
    module = kernels_for(frame.depth_m)
    if module is None:
        sums = alignment_numpy.accumulate(
            (model.texture.numpy(), model.surface.numpy()),
            (frame.intensity.numpy(), frame.depth_m.numpy()),
            cameras,
            T_model_frame,
            scalars,
        )
    else:
        sums = np.empty(_SUMS)
        module.align_accumulate(
            [(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras],
            [camera.size for camera in cameras],
            [address(t) for t in (model.texture, model.surface, frame.intensity, frame.depth_m)],
            np.asarray(T_model_frame[:3]).reshape(-1).tolist(),
            scalars,
            sums.ctypes.data,
        )
    return _unpack(sums)


def rescaled(scales: Scales, linear: Linearisation) -> Scales:
    """Scales of Student's t from the last residuals: one step of its fixed point."""
    intensity = scales.intensity * np.sqrt(linear.intensity_variance)
    depth_m = scales.depth_m * np.sqrt(linear.depth_variance)
    if linear.intensity_pixels:
        held = np.clip(intensity, LEAST_SCALES.intensity, MOST_SCALES.intensity)
        scales = replace(scales, intensity=float(held))
    if linear.depth_pixels:
        held = np.clip(depth_m, LEAST_SCALES.depth_m, MOST_SCALES.depth_m)
        scales = replace(scales, depth_m=float(held))
    return scales


def _unpack(sums: NDArray[np.float64]) -> Linearisation:
    H = np.zeros((8, 8))
    H[np.triu_indices(8)] = sums[:36]
    H = H + np.triu(H, 1).T
    intensity_pixels, depth_pixels, intensity_squares, depth_squares, frame_pixels = sums[44:49]
    return Linearisation(
        H=H,
        g=sums[36:44].copy(),
        intensity_pixels=float(intensity_pixels),
        depth_pixels=float(depth_pixels),
        intensity_variance=float(intensity_squares / max(intensity_pixels, 1.0)),
        depth_variance=float(depth_squares / max(depth_pixels, 1.0)),
        frame_pixels=float(frame_pixels),
    )
