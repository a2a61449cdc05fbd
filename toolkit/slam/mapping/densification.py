"""Densification: seeds Gaussians where the map is incomplete, and prunes Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe, Observed
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.submaps.submap import Submap
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.seeding import seed
from toolkit.splatting.rendering import SurfaceView
from toolkit.splatting.rendering.output import COLOUR

# Minimum depth error that seeds new Gaussians in front of a surface: as a fraction of depth, and as
# a multiple of the median depth error.
_DEPTH_FLOOR, _DEPTH_FACTOR = 0.03, 20.0
# Colours are compared at every n-th pixel in each direction, if this fraction of them shows mapped
# surfaces. The standard deviation is this multiple of the median absolute deviation.
_NOISE_STRIDE, _MIN_SHOWN, _SIGMA_PER_MEDIAN = 4, 0.1, 1.4826
# Gaussians of lower opacity or larger radius are pruned.
_MIN_OPACITY, _MAX_RADIUS_M = 0.005, 0.5


class Densification:
    """Adds and removes Gaussians of a map.

    Args:
        semantics: features of new Gaussians.
        generator: draws random features, and pixels if only a random fraction of them is seeded.
    """

    def __init__(
        self, options: MapperOptions, semantics: SemanticMapping, generator: np.random.Generator
    ) -> None:
        self._options, self._semantics, self._generator = options, semantics, generator
        self._start_values = semantics.start_values

    def seed(
        self,
        submap: Submap,
        keyframe: Keyframe,
        view: SurfaceView,
        observed: Observed,
        in_empty_space: Callable[[Tensor], Tensor] | None = None,
    ) -> int:
        """Seed Gaussians at the pixels that the map does not explain; return how many.

        Args:
            view: the map rendered from the keyframe.
            observed: images of the keyframe on the map's device.
            in_empty_space: mask [N] of the points [N, 3] where nothing is seeded.
        """
        mask = uncovered_pixels(
            view,
            observed.measured_m,
            self._options.min_silhouette,
            _DEPTH_FLOOR,
            _DEPTH_FACTOR,
        )
        if observed.inferred is not None:
            # Inferred depth does not contradict a surface of the map.
            mask |= observed.inferred & ~self.covered(view)
        noise = colour_noise(view, keyframe, observed)
        seeds = self.seeds(keyframe.as_frame(), keyframe.T_map_camera, mask.cpu().numpy(), noise)
        if in_empty_space is not None and len(seeds):
            seeds = seeds.select(~in_empty_space(seeds.means))
        if len(seeds):
            submap.append(seeds, keyframe)
        return len(seeds)

    def seeds(
        self,
        frame: Frame,
        T_map_camera: NDArray[np.float64],
        mask: NDArray[np.bool_],
        noise: float = 0.0,
    ) -> GaussianCloud:
        """Gaussians for the pixels of a frame that have a depth and are in a mask [H, W].

        Args:
            noise: standard deviation of the frame's colours from those of the map, 0 if unknown.
        """
        options, start_values = self._options.seeding, self._start_values
        seeds = seed(frame, T_map_camera, mask, options, start_values, self._generator, noise)
        if self._semantics.random_start:
            random = self._generator.standard_normal(seeds.features.shape, np.float32)
            seeds = replace(seeds, features=torch.from_numpy(random))
        return seeds

    def covered(self, view: SurfaceView) -> Tensor:
        """Mask [H, W] of the pixels of a rendered view that the map covers."""
        return view.output.silhouette >= self._options.min_silhouette

    def unmapped_pixels(
        self,
        view: SurfaceView,
        frame: Frame,
        T_map_camera: NDArray[np.float64],
        keyframes: Sequence[Keyframe],
    ) -> NDArray[np.bool_]:
        """Mask [H, W] of a frame's measured pixels without Gaussians that no keyframe shows.

        Args:
            view: the map rendered from the frame.
            T_map_camera: [4, 4] pose of the frame.
            keyframes: those next to the frame.
        """
        mask = ~self.covered(view).cpu().numpy() & (frame.depth_m > 0)
        points_map = se3.transform_points(T_map_camera, frame.camera.unproject(frame.depth_m)[mask])
        mask[mask] = ~np.any([k.reaches(points_map) for k in keyframes], axis=0)
        return mask

    def seed_pixels(
        self,
        submap: Submap,
        frame: Frame,
        T_map_camera: NDArray[np.float64],
        mask: NDArray[np.bool_],
        keyframe: Keyframe,
    ) -> None:
        """Seed Gaussians for pixels of a frame that does not become a keyframe.

        Args:
            frame: at the map's exposure, with labels of the map's taxonomy.
            T_map_camera: [4, 4] pose of the frame.
            mask: [H, W], which pixels.
            keyframe: the Gaussians move with it.
        """
        if self._semantics.channels == 0:
            frame = replace(frame, labels=None)
        if frame.labels is not None:
            self._semantics.observe(torch.from_numpy(frame.labels[mask]))
        seeds = self.seeds(frame, T_map_camera, mask)
        submap.append(seeds, keyframe)

    def prune(self, submap: Submap) -> None:
        """Remove transparent, very large and non-finite Gaussians."""
        mask = prune_mask(submap.gaussians, _MIN_OPACITY, _MAX_RADIUS_M)
        if mask.any():
            submap.remove(mask)


def colour_noise(view: SurfaceView, keyframe: Keyframe, observed: Observed) -> float:
    """Robust standard deviation of a keyframe's colours from those of the rendered map.

    It is 0 where the map shows too little of the keyframe.

    Args:
        view: the map rendered from the keyframe.
        observed: images of the keyframe on the map's device.
    """
    sparse = (..., slice(None, None, _NOISE_STRIDE), slice(None, None, _NOISE_STRIDE))
    depth_m, rendered_m = observed.measured_m[sparse], view.depth_m[sparse]
    shown = (depth_m > 0) & ((rendered_m - depth_m).abs() < _DEPTH_FLOOR * depth_m)
    if float(shown.float().mean()) < _MIN_SHOWN:
        return 0.0
    difference = keyframe.target_rgb(observed)[sparse] - view.output.images[COLOUR][sparse]
    return _SIGMA_PER_MEDIAN * float(difference.abs()[:, shown].median())


def uncovered_pixels(
    view: SurfaceView, depth_m: Tensor, min_silhouette: float, floor: float, factor: float
) -> Tensor:
    """Mask [H, W] of the measured pixels that a map does not explain (H, densification).

    Args:
        view: the rendered map.
        depth_m: [H, W] measured depth, 0 where missing.
        min_silhouette: pixels below it are uncovered.
        floor, factor: pixels are uncovered if the map lies behind the measured depth by more than
            `floor` times the depth and by more than `factor` times the median depth error.
    """
    measured = depth_m > 0
    transparent = view.output.silhouette < min_silhouette
    opaque = measured & ~transparent
    behind = torch.where(opaque, view.depth_m - depth_m, torch.zeros_like(depth_m))
    errors = behind.abs()[opaque]
    median = float(errors.median()) if errors.numel() else 0.0
    threshold = (floor * depth_m).clamp(min=factor * median)
    return measured & (transparent | (behind > threshold))


def prune_mask(gaussians: GaussianCloud, min_opacity: float, max_radius_m: float) -> Tensor:
    """Mask [N] of the Gaussians that are transparent, too large or not finite."""
    mask = gaussians.opacity_logits < _logit(min_opacity)
    mask |= gaussians.log_radii > math.log(max_radius_m)
    # A sum of coordinates is finite if all of them are; reductions over short axes are slow.
    x, y, z = gaussians.means.unbind(dim=1)
    mask |= ~torch.isfinite(x + y + z)
    return mask


def _logit(probability: float) -> float:
    """The logit of a probability, infinite at 0 and from 1 on."""
    if 0.0 < probability < 1.0:
        return math.log(probability / (1.0 - probability))
    return -math.inf if probability <= 0.0 else math.inf
