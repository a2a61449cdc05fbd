"""Texture atlas: all charts of a scene, packed into one image with mip levels."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.datasets.synthetic_rooms.canvas import Canvas
from toolkit.datasets.synthetic_rooms.parts import Part

# The border of each chart is replicated by this many texels, so that charts do not bleed into
# each other at any mip level.
_MARGIN = 8
MIP_LEVELS = 4
# Widths to try, in texels. OpenCV limits the sides of images to 32767, the mip levels included.
_WIDTHS, _MAX_ROWS = (4096, 8192, 16384), 32767
# Factor by which texels are enlarged if none suffices.
_COARSER = 1.25


@dataclass(frozen=True)
class TextureAtlas:
    """Texture atlas.

    Attributes:
        image: [rows, columns, 3] uint8 RGB; mip level 0 at the top, smaller levels below.
        texel_m: edge of a texel of level 0, metres.
        level_origin: [MIP_LEVELS, 2] float32, (x, y) of each level's first texel.
    """

    image: NDArray[np.uint8]
    texel_m: float
    level_origin: NDArray[np.float32]

    def sample(self, xy: NDArray[np.float32], level: NDArray[np.float32]) -> NDArray[np.float32]:
        """Sample colours [N, 3] in [0, 255] with trilinear filtering.

        Args:
            xy: [N, 2] texel coordinates on level 0, texel centres at integers.
            level: [N] mip level, clipped to the valid range.
        """
        if len(xy) == 0:  # which OpenCV refuses
            return np.zeros((0, 3), dtype=np.float32)
        level = np.clip(level, 0.0, MIP_LEVELS - 1.001)
        lower = level.astype(np.int32)
        fraction = (level - lower.astype(np.float32))[:, None]
        fine = self._sample_level(xy, lower)
        return fine + (self._sample_level(xy, lower + 1) - fine) * fraction

    def _sample_level(self, xy: NDArray, level: NDArray[np.int32]) -> NDArray[np.float32]:
        scale = np.exp2(-level.astype(np.float32))[:, None]
        place = (xy + np.float32(0.5)) * scale - np.float32(0.5) + self.level_origin[level]
        # OpenCV limits the sides of the maps to 32767.
        columns = 512
        rows = math.ceil(len(place) / columns)
        padded = np.zeros((rows * columns, 2), dtype=np.float32)
        padded[: len(place)] = place
        colours = cv2.remap(
            self.image, padded.reshape(rows, columns, 2), None, cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
        return colours.reshape(-1, 3)[: len(place)].astype(np.float32)


def paint_atlas(
    parts: list[Part], texel_m: float
) -> tuple[TextureAtlas, list[NDArray[np.float32]]]:
    """Paint the textures of all patches.

    Args:
        texel_m: edge of a texel, metres; in scenes that do not fit into an image, texels are
            larger.

    Returns:
        The atlas, and the texel coordinates [R, C, 2] of each patch.
    """
    patches = [(part, patch) for part in parts for patch in part.patches]
    while True:
        sizes = [_texels(patch.chart_size_m, texel_m) for _, patch in patches]
        packed = _packed([(w + 2 * _MARGIN, h + 2 * _MARGIN) for w, h in sizes])
        if packed is not None:
            break
        texel_m *= _COARSER
    corners, width, height = packed
    base = np.zeros((height, width, 3), dtype=np.uint8)
    streams = {id(part): iter(part.rng.spawn(len(part.patches))) for part in parts}
    coordinates = []
    for (part, patch), size, (left, top) in zip(patches, sizes, corners, strict=True):
        painted = part.texture(Canvas(size, texel_m, next(streams[id(part)])))
        chart = np.round(np.clip(painted, 0.0, 1.0) * 255.0).astype(np.uint8)
        chart = cv2.copyMakeBorder(chart, *[_MARGIN] * 4, cv2.BORDER_REPLICATE)
        base[top : top + chart.shape[0], left : left + chart.shape[1]] = chart
        origin = np.array([left, top]) + _MARGIN - 0.5
        coordinates.append((patch.uv_m / texel_m + origin).astype(np.float32))
    return _with_mip_levels(base, texel_m), coordinates


def _texels(size_m: tuple[float, float], texel_m: float) -> tuple[int, int]:
    width, height = (max(2, math.ceil(side / texel_m)) for side in size_m)
    return width, height


def _packed(sizes: list[tuple[int, int]]) -> tuple[list[tuple[int, int]], int, int] | None:
    """Pack rectangles into the narrowest image that is not too high.

    Returns:
        Their corners, and the width and height of the image; None if all are too high.
    """
    for columns in _WIDTHS:
        if max(width for width, _ in sizes) > columns:
            continue
        corners, rows = _pack(sizes, columns)
        if rows + rows // 2 <= _MAX_ROWS - 1:
            return corners, columns, rows
    return None


def _pack(sizes: list[tuple[int, int]], columns: int) -> tuple[list[tuple[int, int]], int]:
    """Pack rectangles in shelves by decreasing height; return their corners and the height."""
    corners = [(0, 0)] * len(sizes)
    left, top, shelf = 0, 0, 0
    for number in sorted(range(len(sizes)), key=lambda i: (-sizes[i][1], i)):
        width, height = sizes[number]
        if left + width > columns:
            left, top, shelf = 0, top + shelf, 0
        corners[number] = (left, top)
        left, shelf = left + width, max(shelf, height)
    coarsest = 2 ** (MIP_LEVELS - 1)
    return corners, math.ceil((top + shelf) / coarsest) * coarsest


def _with_mip_levels(base: NDArray[np.uint8], texel_m: float) -> TextureAtlas:
    height, width, _ = base.shape
    image = np.zeros((height + height // 2, width, 3), dtype=np.uint8)
    image[:height] = base
    origin = [(0, 0)]
    level, left = base, 0
    for _ in range(MIP_LEVELS - 1):
        level = cv2.resize(
            level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
        image[height : height + level.shape[0], left : left + level.shape[1]] = level
        origin.append((left, height))
        left += level.shape[1]
    return TextureAtlas(image, texel_m, np.array(origin, dtype=np.float32))
