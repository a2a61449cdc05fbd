"""Binning: visible Gaussians of a view and the tiles that they intersect, front to back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import TILE
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.cuda import ellipsoids, projection

_BLOCK = 128  # Gaussians per program


@dataclass(frozen=True)
class Binning:
    """Projected Gaussians and the P pairs of a Gaussian and a tile.

    Each pair has a row for its gradients. The rows of one Gaussian are contiguous and in a fixed
    order.

    Attributes:
        view: [16] float32, see projection.VIEW.
        splats: [N, 8] float32, or [N, 12] if the Gaussians are shaped; valid for visible ones.
        ids: [V] int64, ascending ids of the visible Gaussians.
        begins, counts: [V] int64, int32: first row and number of rows of each visible Gaussian.
        row_tiles: [P] int16 or int32, the tile of each row; `tiles` for rows that no tile writes.
        gaussians, rows: [P] int32, int64, Gaussian and row of each pair, sorted by tile and then
            front to back.
        tile_begins: [tiles + 1] int32, index of the first pair of each tile.
        columns, tiles: number of tile columns and of tiles of the image.
    """

    view: Tensor
    splats: Tensor
    ids: Tensor
    begins: Tensor
    counts: Tensor
    row_tiles: Tensor
    gaussians: Tensor
    rows: Tensor
    tile_begins: Tensor
    columns: int
    tiles: int


def view_of(camera: Camera, T_camera_map: NDArray[np.float64], device: torch.device) -> Tensor:
    """Return pose and intrinsics as a kernel argument, [16] float32."""
    numbers = np.empty(projection.VIEW, dtype=np.float32)
    numbers[:12] = np.asarray(T_camera_map)[:3].reshape(-1)
    numbers[12:] = camera.fx, camera.fy, camera.cx, camera.cy
    return torch.from_numpy(numbers).to(device)


@dataclass(frozen=True)
class _Projected:
    """Projected Gaussians; the other values of a Gaussian are undefined if its count is 0.

    Attributes:
        view: [16] float32. splats: [N, 8] or [N, 12] float32.
        rectangles: [N, 4] int16, rectangle of tiles: x, y, columns, rows.
        counts: [N] int32, number of intersected tiles.
    """

    view: Tensor
    splats: Tensor
    rectangles: Tensor
    counts: Tensor


@dataclass(frozen=True)
class _Grid:
    """Tiles of an image and the region to render, None for all."""

    camera: Camera
    side: int
    region: Tensor | None

    @property
    def columns(self) -> int:
        return -(-self.camera.width // self.side)

    @property
    def tiles(self) -> int:
        return self.columns * -(-self.camera.height // self.side)

    @property
    def region_columns(self) -> int:
        return -(-self.camera.width // TILE)


def bin_gaussians(
    cloud: GaussianCloud,
    camera: Camera,
    T_camera_map: NDArray[np.float64],
    region: Tensor | None,
    side: int,
) -> Binning:
    """Project Gaussians and sort their pairs by depth and then, with a stable sort, by tile.

    Two sorts move less data than one sort of 64-bit keys, and Gaussians of equal depth keep their
    order in the map. The host synchronises twice, for the numbers of Gaussians and of pairs.

    Args:
        cloud: contiguous float32. region: contiguous uint8 or None.
        side: side of a tile in pixels, a divisor of 16.
    """
    grid = _Grid(camera, side, region)
    view = view_of(camera, T_camera_map, cloud.means.device)
    if ellipsoids.is_shaped(cloud):
        splats = ellipsoids.splats_of(cloud, camera, T_camera_map)
        projected = _covered(splats, view, grid)
    else:
        projected = _projected(cloud, view, grid)
    ids = projected.counts.nonzero().squeeze(1)
    order = torch.sort(projected.splats[ids, 7], stable=True).indices
    counts = projected.counts[ids]
    ends = counts[order].cumsum(0)
    begins_by_depth = ends - counts[order]
    pairs = int(ends[-1]) if len(ids) else 0
    row_tiles, row_gaussians = _pairs(projected, (ids[order], begins_by_depth), pairs, grid)
    tiles, listed = torch.sort(row_tiles, stable=True)
    limits = torch.arange(grid.tiles + 1, dtype=tiles.dtype, device=tiles.device)
    begins = torch.empty_like(begins_by_depth)
    begins[order] = begins_by_depth
    return Binning(
        view=projected.view,
        splats=projected.splats,
        ids=ids,
        begins=begins,
        counts=counts,
        row_tiles=row_tiles,
        gaussians=row_gaussians[listed],
        rows=listed,
        tile_begins=torch.searchsorted(tiles, limits, out_int32=True),
        columns=grid.columns,
        tiles=grid.tiles,
    )


def _around(splats: Tensor, view: Tensor) -> _Projected:
    count, device = len(splats), view.device
    return _Projected(
        view,
        splats,
        rectangles=torch.empty(count, 4, dtype=torch.int16, device=device),
        counts=torch.empty(count, dtype=torch.int32, device=device),
    )


def _covered(splats: Tensor, view: Tensor, grid: _Grid) -> _Projected:
    count, out = len(splats), _around(splats, view)
    if count:
        projection.cover[(triton.cdiv(count, _BLOCK),)](
            splats,
            view if grid.region is None else grid.region,
            out.rectangles,
            out.counts,
            count,
            grid.camera.width,
            grid.camera.height,
            grid.region_columns,
            SIDE=grid.side,
            HAS_REGION=grid.region is not None,
            BLOCK=_BLOCK,
        )
    return out


def _projected(cloud: GaussianCloud, view: Tensor, grid: _Grid) -> _Projected:
    count = len(cloud)
    splats = cloud.means.new_empty(count, int(projection.SPLAT.value))
    out = _around(splats, view)
    if count:
        projection.project[(triton.cdiv(count, _BLOCK),)](
            view,
            cloud.means,
            cloud.log_radii,
            cloud.opacity_logits,
            cloud.colours,
            view if grid.region is None else grid.region,
            out.splats,
            out.rectangles,
            out.counts,
            count,
            grid.camera.width,
            grid.camera.height,
            grid.region_columns,
            SIDE=grid.side,
            HAS_REGION=grid.region is not None,
            BLOCK=_BLOCK,
        )
    return out


def _pairs(
    projected: _Projected, by_depth: tuple[Tensor, Tensor], pairs: int, grid: _Grid
) -> tuple[Tensor, Tensor]:
    """List tile and Gaussian [P] of every pair, front to back.

    Args:
        by_depth: ids of the visible Gaussians from front to back, and the index of the first pair
            of each.
    """
    device, visible = projected.view.device, len(by_depth[0])
    key = torch.int16 if grid.tiles < 2**15 else torch.int32
    tiles = torch.empty(pairs, dtype=key, device=device)
    gaussians = torch.empty(pairs, dtype=torch.int32, device=device)
    if pairs:
        projection.list_pairs[(triton.cdiv(visible, _BLOCK),)](
            projected.splats,
            *by_depth,
            projected.rectangles,
            projected.view if grid.region is None else grid.region,
            tiles,
            gaussians,
            visible,
            grid.columns,
            grid.tiles,
            grid.region_columns,
            SIDE=grid.side,
            HAS_REGION=grid.region is not None,
            SHAPED=projected.splats.shape[1] == projection.SHAPED_SPLAT.value,
            BLOCK=_BLOCK,
        )
    return tiles, gaussians
