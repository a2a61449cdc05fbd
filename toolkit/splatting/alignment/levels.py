"""Pyramids of frames and of rendered views."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.frame import Frame
from toolkit.base.keyframe import Keyframe
from toolkit.base.native.constants import MAX_DEPTH_STEP
from toolkit.splatting.alignment.backend import backend_for
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel
from toolkit.splatting.alignment.reference import LUMA
from toolkit.splatting.rendering.surface import SurfaceView
from toolkit.splatting.rendering.texture import centred_intensity, shift_to_centres


def intensity_of(rgb: NDArray[np.float32]) -> Tensor:
    """Luma [H, W] of an RGB image [H, W, 3]."""
    return torch.from_numpy(np.ascontiguousarray(rgb @ LUMA))


def finest_level(frame: Frame, device: torch.device) -> FrameLevel:
    """The finest pyramid level of a frame, on a device."""
    intensity, depth_m = intensity_of(frame.rgb), torch.from_numpy(frame.depth_m)
    return FrameLevel(frame.camera, _on_device(intensity, device), _on_device(depth_m, device))


def keyframe_level(keyframe: Keyframe) -> FrameLevel:
    """The finest pyramid level of a keyframe, at the map's exposure."""
    rgb = keyframe.target_rgb().permute(1, 2, 0).contiguous().numpy()
    return FrameLevel(keyframe.camera, intensity_of(rgb), keyframe.depth_m)


def _on_device(image: Tensor, device: torch.device) -> Tensor:
    """A CPU image on a device; copies to a GPU are asynchronous, from pinned memory."""
    if device.type != "cuda":
        return image.to(device)
    return image.pin_memory().to(device, non_blocking=True)


def halved(level: FrameLevel, halvings: int = 0) -> FrameLevel:
    """The next coarser level: intensity and depth of the nearest surface in each 2x2 cell.

    Args:
        halvings: number of times that the level itself was halved. The rays of its pixels are
            that much farther apart, so depths on one surface differ by more.
    """
    return backend_for(level.depth_m).halve(level, MAX_DEPTH_STEP * 2**halvings)


def pyramid(level: FrameLevel, levels: int) -> list[FrameLevel]:
    """Levels from fine to coarse."""
    out = [level]
    while len(out) < levels:
        out.append(halved(out[-1], halvings=len(out) - 1))
    return out


def limited_to_width(level: FrameLevel, max_width: int, min_pixels: int = 0) -> FrameLevel:
    """A level halved until it is no wider than `max_width`, while it keeps `min_pixels` pixels."""
    while level.camera.width > max_width and level.depth_m.numel() // 4 >= min_pixels:
        level = halved(level)
    return level


def view_level(view: SurfaceView, min_silhouette: float) -> FrameLevel:
    """Intensity and surface depth of a rendered view, 0 where its silhouette is below a minimum."""
    centred = view.centred_colours
    intensity = centred_intensity(view, min_silhouette) if centred else None
    if intensity is None:
        intensity = backend_for(view.images).intensity(view.images, min_silhouette)
        if centred:
            intensity = shift_to_centres(intensity, view, min_silhouette)
    return FrameLevel(view.camera, intensity, view.depth_m)


def model_level(level: FrameLevel) -> ModelLevel:
    """Derivatives of the intensity and planes of the depth of one level."""
    return backend_for(level.depth_m).model(level)
