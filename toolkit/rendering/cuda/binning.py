"""Which Gaussians a view shows, and which tiles they touch, front to back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.rendering.cuda import projection

_BLOCK = 128  # Gaussians a program


@dataclass(frozen=True)
class Binning:
    """Projected Gaussians and the P pairs of a Gaussian and a tile.

    A pair has a row, in the order of Gaussians, where its gradients go: those of one Gaussian
    lie side by side, and in the same order each time.

    Attributes:
        view: [16] float32, see projection.VIEW.
        splats: [N, 8] float32, written where a Gaussian is seen.
        ids: [V] int64, ascending, the Gaussians that are seen.
        begins, counts: [V] int64, int32: their rows.
        row_tiles: [P] int16 or int32, the tile of each row.
        gaussians, rows: [P] int32, int64, by tile and front to back.
        tile_begins: [tiles + 1] int32 into them.
        columns, tiles: of the image.
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
    """Pose and intrinsics as the kernels take them, [16] float32."""
    numbers = np.empty(projection.VIEW, dtype=np.float32)
    numbers[:12] = np.asarray(T_camera_map)[:3].reshape(-1)
    numbers[12:] = camera.fx, camera.fy, camera.cx, camera.cy
    return torch.from_numpy(numbers).to(device)


def bin_gaussians(
    cloud: GaussianCloud,
    camera: Camera,
    T_camera_map: NDArray[np.float64],
    region: Tensor | None,
    side: int,
) -> Binning:
    """Project Gaussians and sort their pairs: by depth first, then stably by tile.

    The two sorts move less than one sort of 64-bit keys, and equal depths keep the order of
    the map. The host waits twice, for the numbers of Gaussians and of pairs.

    Args:
        cloud: contiguous float32. region: contiguous bool or None.
        side: of a tile in pixels, which divides 16.
    """
    device, count = cloud.means.device, len(cloud)
    columns, rows = -(-camera.width // side), -(-camera.height // side)
    regions = (region if region is not None else cloud.means, -(-camera.width // 16))
    view = view_of(camera, T_camera_map, device)
    splats = torch.empty(count, int(projection.SPLAT.value), device=device)
    rectangles = torch.empty(count, 4, dtype=torch.int16, device=device)
    all_counts = torch.empty(count, dtype=torch.int32, device=device)
    if count:
        projection.project[(triton.cdiv(count, _BLOCK),)](
            view,
            cloud.means,
            cloud.log_radii,
            cloud.opacity_logits,
            cloud.colours,
            regions[0],
            splats,
            rectangles,
            all_counts,
            count,
            camera.width,
            camera.height,
            regions[1],
            SIDE=side,
            HAS_REGION=region is not None,
            BLOCK=_BLOCK,
        )
    ids = all_counts.nonzero().squeeze(1)
    order = torch.sort(splats[ids, 7], stable=True).indices
    by_depth = ids[order]
    counts = all_counts[ids]
    ends = counts[order].cumsum(0)
    pairs = int(ends[-1]) if len(ids) else 0
    by_depth_begins = ends - counts[order]
    key = torch.int16 if columns * rows < 2**15 else torch.int32
    row_tiles = torch.empty(pairs, dtype=key, device=device)
    row_gaussians = torch.empty(pairs, dtype=torch.int32, device=device)
    if pairs:
        projection.list_pairs[(triton.cdiv(len(ids), _BLOCK),)](
            by_depth,
            by_depth_begins,
            rectangles,
            regions[0],
            row_tiles,
            row_gaussians,
            len(ids),
            columns,
            regions[1],
            SIDE=side,
            HAS_REGION=region is not None,
            BLOCK=_BLOCK,
        )
    tiles, listed = torch.sort(row_tiles, stable=True)
    limits = torch.arange(columns * rows + 1, dtype=key, device=device)
    begins = torch.empty_like(by_depth_begins)
    begins[order] = by_depth_begins
    return Binning(
        view=view,
        splats=splats,
        ids=ids,
        begins=begins,
        counts=counts,
        row_tiles=row_tiles,
        gaussians=row_gaussians[listed],
        rows=listed,
        tile_begins=torch.searchsorted(tiles, limits, out_int32=True),
        columns=columns,
        tiles=columns * rows,
    )
