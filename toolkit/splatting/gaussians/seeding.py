"""Seeding of Gaussians from the pixels of an RGB-D frame.

On a Replica view with one Gaussian per pixel and before any optimisation, radius `d / f` with
opacity 0.5 (the papers' values) yields a PSNR of 32 dB, and `0.6 d / f` with opacity 0.95 yields
38 dB.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.splatting.gaussians.allocation import (
    choose_pixels,
    pixels_per_class,
    printed_pixels_per_class,
)
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.options import SeedingOptions

# Maximum curvature of a block of pixels that becomes one Gaussian, as a fraction of depth.
_FLAT_DEPTH = 0.005
# Maximum colour range of a block of 2x2 pixels, for colours in [0, 1]. It falls with the side
# length of larger blocks.
_FLAT_COLOUR = 0.04
# Where the map and its images differ, by exposure, blur, noise and small errors of poses, finer
# Gaussians only follow these differences. A colour range up to this multiple of them, times the
# focal length in pixels, is flat, too: at a higher resolution, less of the texture is in the
# differences between neighbours. It falls with the square root of the side length. RedKitchen of
# 640x480 pixels then has two fifths fewer Gaussians, and renderings of it gain 0.1 dB.
_FLAT_NOISE, _MAX_FLAT_NOISE = 1 / 90, 0.2
# Largest block of more than 2x2 pixels, in focal lengths.
_MAX_BLOCK = 1 / 64


def flat_range(side: int, focal: float, noise: float) -> float:
    """Maximum colour range of a block that becomes one Gaussian.

    Args:
        side: length in pixels, at least 2.
        focal: focal length in pixels.
        noise: standard deviation of the frame's colours from those of the map.
    """
    blocks = side / 2
    within_noise = min(_FLAT_NOISE * focal * noise, _MAX_FLAT_NOISE) / blocks**0.5
    return max(_FLAT_COLOUR / blocks, within_noise)


def seed(  # noqa: PLR0913 - what is seeded, where, and how
    frame: Frame,
    T_map_camera: NDArray[np.float64],
    mask: NDArray[np.bool_],
    options: SeedingOptions,
    start_values: torch.Tensor | None = None,
    generator: np.random.Generator | None = None,
    noise: float = 0.0,
) -> GaussianCloud:
    """Create Gaussians in the map's frame for the masked pixels with valid depth.

    Args:
        frame: RGB-D frame.
        T_map_camera: [4, 4] pose of the frame.
        mask: [H, W] pixels that the map does not cover.
        options: parameters of seeding.
        start_values: [C + 1, S] initial features by class id; row 0 is used for void and for
            frames without labels. None for S = 0.
        generator: source of randomness if pixels are sampled.
        noise: standard deviation of the frame's colours from those of the map, 0 if unknown.
    """
    wanted = mask & (frame.depth_m > 0)
    if options.choice != "cells":
        printed = options.choice == "paper"
        chosen, area = choose_pixels(
            wanted,
            None if options.choice == "uniform" else frame.labels,
            options.share,
            generator or np.random.default_rng(0),
            printed_pixels_per_class if printed else pixels_per_class,
        )
        if printed:
            return _seed_cells(frame, T_map_camera, chosen, 1, options, start_values)
        cloud = _seed_cells(frame, T_map_camera, chosen, 1, options, start_values)
        grown = torch.from_numpy(np.log(area[chosen]) / 2).to(cloud.log_radii)
        return replace(cloud, log_radii=cloud.log_radii + grown)
    parts = []
    cell: int = options.max_cell
    while cell > 2 and cell > _MAX_BLOCK * frame.camera.focal:
        cell //= 2
    while cell >= 1:
        chosen = wanted
        if cell > 1:
            flat = flat_range(cell, frame.camera.focal, noise)
            chosen = _plain_cells(frame, wanted, cell, flat)
        parts.append(_seed_cells(frame, T_map_camera, chosen, cell, options, start_values))
        wanted = wanted & ~chosen
        cell //= 2
    return GaussianCloud.concatenate(parts)


def _complete_cells(mask: NDArray[np.bool_], cell: int) -> NDArray[np.bool_]:
    """Mask [rows, columns] of the cells whose pixels are all set; incomplete cells are dropped."""
    rows, columns = mask.shape[0] // cell, mask.shape[1] // cell
    cut = mask[: rows * cell, : columns * cell]
    return np.asarray(cut.reshape(rows, cell, columns, cell).all(axis=(1, 3)))


def _pixels_of(
    image: NDArray, cell: int, rows: NDArray[np.int64], columns: NDArray[np.int64]
) -> NDArray:
    """Return the pixels [n, cell * cell, ...] of n cells of an image [H, W, ...]."""
    offset = np.arange(cell)
    y = rows[:, None, None] * cell + offset[:, None]
    x = columns[:, None, None] * cell + offset
    return image[y, x].reshape(len(rows), cell * cell, *image.shape[2:])


def _plain_cells(
    frame: Frame, wanted: NDArray[np.bool_], cell: int, flat: float
) -> NDArray[np.bool_]:
    """Return a mask [H, W] of complete cells with a colour range below `flat` and planar depth."""
    full = _complete_cells(wanted, cell)
    rows, columns = np.nonzero(full)
    colour = _pixels_of(frame.rgb, cell, rows, columns)
    depth = _pixels_of(frame.depth_m, cell, rows, columns)
    plain = (colour.max(axis=1) - colour.min(axis=1)).max(axis=-1) < flat
    # Inverse depth is linear on a plane, so the residual of a linear fit measures curvature.
    inverse = 1.0 / np.where(depth > 0, depth, 1.0)
    offset = np.arange(cell) - (cell - 1) / 2
    x, y = np.tile(offset, cell), np.repeat(offset, cell)
    mean = inverse.mean(axis=1, keepdims=True)
    slope_x = (inverse * x).sum(axis=1, keepdims=True) / (x**2).sum()
    slope_y = (inverse * y).sum(axis=1, keepdims=True) / (y**2).sum()
    bend = abs(inverse - mean - slope_x * x - slope_y * y).max(axis=1)
    # On a steep plane there would be gaps between large isotropic Gaussians.
    steep = cell * np.hypot(slope_x[:, 0], slope_y[:, 0]) > 0.05 * mean[:, 0]
    if frame.labels is not None:
        labels = _pixels_of(frame.labels, cell, rows, columns)
        plain &= (labels == labels[:, :1]).all(axis=1)
    full[rows, columns] = plain & (bend < _FLAT_DEPTH * mean[:, 0]) & ~steep
    out = np.zeros_like(wanted)
    height, width = full.shape
    out[: height * cell, : width * cell] = full.repeat(cell, 0).repeat(cell, 1)
    return out


def _seed_cells(
    frame: Frame,
    T_map_camera: NDArray[np.float64],
    chosen: NDArray[np.bool_],
    cell: int,
    options: SeedingOptions,
    start_values: torch.Tensor | None,
) -> GaussianCloud:
    """Create one Gaussian per chosen cell, at its mean ray, depth and colour."""
    rows, columns = np.nonzero(_complete_cells(chosen, cell))
    # On a plane, the depth at the cell's centre is the harmonic mean of the depths.
    inverse = 1.0 / _pixels_of(frame.depth_m, cell, rows, columns)
    depth = 1.0 / inverse.mean(axis=1)
    colour = _pixels_of(frame.rgb, cell, rows, columns).mean(axis=1)
    u, v = columns * cell + (cell - 1) / 2, rows * cell + (cell - 1) / 2
    camera = frame.camera
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], 1)
    points = se3.transform_points(T_map_camera, rays * depth[:, None])
    tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))  # noqa: E731
    depth_t = tensor(depth)
    features = None
    if start_values is not None:
        ids = np.zeros(len(rows), np.int64)
        if frame.labels is not None:  # all pixels of a cell have the same label
            ids = frame.labels[rows * cell, columns * cell].astype(np.int64)
        features = start_values.index_select(0, torch.from_numpy(ids))
    return GaussianCloud.from_values(
        means=tensor(points),
        radii_m=depth_t * (options.radius * cell / camera.focal),
        opacities=torch.full_like(depth_t, options.opacity),
        colours=tensor(colour),
        features=features,
    )
