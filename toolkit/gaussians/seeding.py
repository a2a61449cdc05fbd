"""New Gaussians from the pixels of an RGB-D frame.

Measured on one Replica view, one Gaussian a pixel, before any optimisation: radius `d / f`
with opacity 0.5 (the papers') renders it at 32 dB, `0.6 d / f` with 0.95 at 38 dB.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3


@dataclass(frozen=True)
class SeedingOptions:
    """How a pixel becomes a Gaussian.

    Attributes:
        radius: standard deviation in units of d / f, the pixel's footprint.
        opacity: start opacity in (0, 1).
        largest_cell: 1, 2 or 4; plain surfaces get one Gaussian for up to this many
            pixels a side.
        flat_colour: largest colour range within a cell that still counts as plain.
        flat_depth: largest deviation of a cell's depth from a plane, as a share of depth.
    """

    radius: float = 0.6
    opacity: float = 0.95
    largest_cell: int = 2
    flat_colour: float = 0.04
    flat_depth: float = 0.005


def seed(
    frame: Frame,
    T_map_camera: NDArray[np.float64],
    mask: NDArray[np.bool_],
    options: SeedingOptions,
    features: torch.Tensor | None = None,
) -> GaussianCloud:
    """Gaussians in the map's frame for the masked pixels that have depth.

    Args:
        mask: [H, W] pixels that the map lacks.
        features: [H, W, S] start values of the feature channels, or None for S = 0.
    """
    wanted = mask & (frame.depth_m > 0)
    parts = []
    cell = options.largest_cell
    while cell >= 1:
        chosen = wanted if cell == 1 else _plain_cells(frame, wanted, cell, options)
        parts.append(_seed_cells(frame, T_map_camera, chosen, cell, options, features))
        wanted = wanted & ~chosen
        cell //= 2
    return GaussianCloud.concatenate(parts)


def _blocks(image: NDArray, cell: int) -> NDArray:
    """Whole cells [rows, columns, cell * cell, ...] of an image; rests are cut off."""
    rows, columns = image.shape[0] // cell, image.shape[1] // cell
    cut = image[: rows * cell, : columns * cell]
    cut = cut.reshape(rows, cell, columns, cell, *image.shape[2:]).swapaxes(1, 2)
    return cut.reshape(rows, columns, cell * cell, *image.shape[2:])


def _plain_cells(
    frame: Frame, wanted: NDArray[np.bool_], cell: int, options: SeedingOptions
) -> NDArray[np.bool_]:
    """Pixels of cells wholly wanted, of one colour and one plane, [H, W]."""
    colour = _blocks(frame.rgb, cell)
    depth = _blocks(frame.depth_m, cell)
    full = _blocks(wanted, cell).all(axis=2)
    plain = (colour.max(axis=2) - colour.min(axis=2)).max(axis=-1) < options.flat_colour
    # Inverse depth is linear on a plane: its residual after a linear fit is the bend.
    inverse = 1.0 / np.where(depth > 0, depth, 1.0)
    offset = np.arange(cell) - (cell - 1) / 2
    x, y = np.tile(offset, cell), np.repeat(offset, cell)
    mean = inverse.mean(axis=2, keepdims=True)
    slope_x = (inverse * x).sum(axis=2, keepdims=True) / (x**2).sum()
    slope_y = (inverse * y).sum(axis=2, keepdims=True) / (y**2).sum()
    bend = abs(inverse - mean - slope_x * x - slope_y * y).max(axis=2)
    # A steep plane would leave gaps between large round Gaussians.
    steep = cell * np.hypot(slope_x[..., 0], slope_y[..., 0]) > 0.05 * mean[..., 0]
    good = full & plain & (bend < options.flat_depth * mean[..., 0]) & ~steep
    out = np.zeros_like(wanted)
    rows, columns = good.shape
    out[: rows * cell, : columns * cell] = good.repeat(cell, 0).repeat(cell, 1)
    return out


def _seed_cells(
    frame: Frame,
    T_map_camera: NDArray[np.float64],
    chosen: NDArray[np.bool_],
    cell: int,
    options: SeedingOptions,
    features: torch.Tensor | None,
) -> GaussianCloud:
    """One Gaussian for each chosen cell, at its mean ray, depth and colour."""
    rows, columns = np.nonzero(_blocks(chosen, cell).all(axis=2))
    # The harmonic mean of depths is the depth of a plane at the cell's centre.
    inverse = 1.0 / _blocks(frame.depth_m, cell)[rows, columns]
    depth = 1.0 / inverse.mean(axis=1)
    colour = _blocks(frame.rgb, cell)[rows, columns].mean(axis=1)
    u, v = columns * cell + (cell - 1) / 2, rows * cell + (cell - 1) / 2
    camera = frame.camera
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], 1)
    points = se3.transform_points(T_map_camera, rays * depth[:, None])
    tensor = lambda array: torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))  # noqa: E731
    depth_t = tensor(depth)
    if features is not None:
        centre = cell // 2
        features = features[
            torch.from_numpy(rows * cell + centre), torch.from_numpy(columns * cell + centre)
        ]
    return GaussianCloud.from_values(
        means=tensor(points),
        radii_m=depth_t * (options.radius * cell / camera.focal),
        opacities=torch.full_like(depth_t, options.opacity),
        colours=tensor(colour),
        features=features,
    )
