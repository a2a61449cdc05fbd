"""Patches: surfaces as grids of points with a flat texture chart.

The world is z up, in metres. Seen from the outer side of a patch, its columns run to the right and
its rows down, as in the image on its chart.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from toolkit.base.geometry import se3

# Light is stored at the vertices, so flat surfaces are subdivided as well.
_VERTEX_STEP_M = 0.12


@dataclass(frozen=True)
class TexturedPatch:
    """One surface.

    Attributes:
        points: [R, C, 3] float64, metres; rows run down, columns to the right.
        uv_m: [R, C, 2] float64, chart coordinates of each point, metres, from 0.
        kept: [R - 1, C - 1] bool, False for cells that are holes.
    """

    points: NDArray[np.float64]
    uv_m: NDArray[np.float64]
    kept: NDArray[np.bool_]

    @property
    def chart_size_m(self) -> tuple[float, float]:
        """(width, height) of the chart in metres."""
        width, height = self.uv_m.reshape(-1, 2).max(axis=0)
        return float(width), float(height)

    def transformed(self, T_new_old: NDArray[np.float64]) -> TexturedPatch:
        """Return the patch transformed by a rigid motion [4, 4]."""
        return replace(self, points=se3.transform_points(T_new_old, self.points))

    def normals(self) -> NDArray[np.float64]:
        """Compute unit normals [R, C, 3] that point to the outer side."""
        down = np.gradient(self.points, axis=0)
        right = np.gradient(self.points, axis=1)
        normals = np.cross(down, right)
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        return normals / np.maximum(length, 1e-12)

    def triangles(self) -> NDArray[np.int64]:
        """Return triangles [M, 3] as indices into the points in row-major order."""
        rows, columns = self.points.shape[:2]
        index = np.arange(rows * columns).reshape(rows, columns)
        a, b = index[:-1, :-1], index[:-1, 1:]
        c, d = index[1:, :-1], index[1:, 1:]
        upper = np.stack([a, c, b], axis=-1)[self.kept]
        lower = np.stack([b, c, d], axis=-1)[self.kept]
        return np.concatenate([upper, lower])


def _grid(points: NDArray[np.float64], uv_m: NDArray[np.float64]) -> TexturedPatch:
    kept = np.ones((points.shape[0] - 1, points.shape[1] - 1), dtype=bool)
    uv_m = uv_m - uv_m.reshape(-1, 2).min(axis=0)
    return TexturedPatch(points, uv_m, kept)


def plate(
    corner: ArrayLike,
    right: ArrayLike,
    down: ArrayLike,
    holes: tuple[tuple[float, float, float, float], ...] = (),
) -> TexturedPatch:
    """Create a flat rectangle.

    Args:
        corner: upper left corner [3] seen from outside, metres.
        right, down: perpendicular edge vectors [3] from the corner, metres.
        holes: openings (left, top, right, bottom) in chart coordinates, metres.
    """
    right_vector, down_vector = np.asarray(right, float), np.asarray(down, float)
    width, height = float(np.linalg.norm(right_vector)), float(np.linalg.norm(down_vector))
    u = _cuts(width, [edge for hole in holes for edge in (hole[0], hole[2])])
    v = _cuts(height, [edge for hole in holes for edge in (hole[1], hole[3])])
    grid_u, grid_v = np.meshgrid(u, v)
    points = (
        np.asarray(corner, float)
        + grid_u[..., None] * (right_vector / width)
        + grid_v[..., None] * (down_vector / height)
    )
    patch = _grid(points, np.stack([grid_u, grid_v], axis=-1))
    middle_u, middle_v = np.meshgrid((u[1:] + u[:-1]) / 2, (v[1:] + v[:-1]) / 2)
    kept = patch.kept
    for left, top, far, bottom in holes:
        inside = (middle_u > left) & (middle_u < far) & (middle_v > top) & (middle_v < bottom)
        kept = kept & ~inside
    return replace(patch, kept=kept)


def _cuts(length: float, edges: list[float]) -> NDArray[np.float64]:
    """Return grid lines from 0 to length that include the edges, equidistant between them."""
    if not edges:
        return np.linspace(0.0, length, max(1, math.ceil(length / _VERTEX_STEP_M)) + 1)
    stops = np.unique(np.clip([0.0, *edges, length], 0.0, length))
    pieces = [
        np.linspace(a, b, max(1, math.ceil((b - a) / _VERTEX_STEP_M)), endpoint=False)
        for a, b in pairwise(stops)
    ]
    return np.concatenate([*pieces, [length]])


def box(size: ArrayLike, base: ArrayLike = (0.0, 0.0, 0.0)) -> list[TexturedPatch]:
    """Create a box of six plates with the centre of its bottom at `base`, metres."""
    sx, sy, sz = np.asarray(size, float)
    x0, y0, z0 = np.asarray(base, float) - [sx / 2, sy / 2, 0.0]
    x1, y1, z1 = x0 + sx, y0 + sy, z0 + sz
    return [
        plate((x0, y0, z1), (sx, 0, 0), (0, 0, -sz)),
        plate((x1, y0, z1), (0, sy, 0), (0, 0, -sz)),
        plate((x1, y1, z1), (-sx, 0, 0), (0, 0, -sz)),
        plate((x0, y1, z1), (0, -sy, 0), (0, 0, -sz)),
        plate((x0, y1, z1), (sx, 0, 0), (0, -sy, 0)),
        plate((x0, y0, z0), (sx, 0, 0), (0, sy, 0)),
    ]


def lathe(
    profile: ArrayLike, base: ArrayLike = (0.0, 0.0, 0.0), sections: int = 24
) -> TexturedPatch:
    """Create a surface of revolution about a vertical axis.

    Args:
        profile: [K, 2] (radius, height above base) in metres, from top to bottom.
        base: lower end of the axis [3], metres.
        sections: number of flat strips around the axis.
    """
    radius, height = np.asarray(profile, float).T
    angle = np.linspace(0.0, 2 * math.pi, sections + 1)
    points = np.stack(
        [
            radius[:, None] * np.cos(angle),
            radius[:, None] * np.sin(angle),
            np.repeat(height[:, None], sections + 1, axis=1),
        ],
        axis=-1,
    )
    steps = np.hypot(np.diff(radius), np.diff(height))
    v = np.concatenate([[0.0], np.cumsum(steps)])
    grid_u, grid_v = np.meshgrid(angle * radius.max(), v)
    return _grid(points + np.asarray(base, float), np.stack([grid_u, grid_v], axis=-1))


def disk(radius: float, centre: ArrayLike, up: bool = True, sections: int = 24) -> TexturedPatch:
    """Create a horizontal disk whose outer side faces up or down."""
    turn = 2 * math.pi if up else -2 * math.pi
    angle = np.linspace(0.0, turn, sections + 1)
    rings = np.linspace(0.0, radius, max(2, math.ceil(radius / _VERTEX_STEP_M) + 1))
    x = rings[:, None] * np.cos(angle)
    y = rings[:, None] * np.sin(angle)
    points = np.stack([x, y, np.zeros_like(x)], axis=-1) + np.asarray(centre, float)
    return _grid(points, np.stack([x, y], axis=-1))


def cylinder(
    radius: float, height: float, base: ArrayLike = (0.0, 0.0, 0.0)
) -> list[TexturedPatch]:
    """Create a closed vertical cylinder with the centre of its bottom at `base`."""
    x, y, z = np.asarray(base, float)
    profile = [(radius, h) for h in _cuts(height, [])[::-1]]
    return [
        lathe(profile, base),
        disk(radius, (x, y, z + height)),
        disk(radius, (x, y, z), up=False),
    ]


def ellipsoid(radii: ArrayLike, centre: ArrayLike) -> TexturedPatch:
    """Create an ellipsoid with semi-axes [3] in metres."""
    polar = np.linspace(0.0, math.pi, 13)
    unit = lathe(np.stack([np.sin(polar), np.cos(polar)], axis=-1))
    rx, ry, rz = np.asarray(radii, float)
    points = unit.points * [rx, ry, rz] + np.asarray(centre, float)
    uv_m = unit.uv_m * [(rx + ry) / 2, (rx + ry + 2 * rz) / 4]
    return TexturedPatch(points, uv_m, unit.kept)


def cushion(size: ArrayLike, base: ArrayLike, exponent: float = 2.0) -> list[TexturedPatch]:
    """Create a cushion whose upper and lower half meet at a seam.

    Args:
        size: width, depth, thickness [3], metres.
        base: centre of the underside [3], metres.
        exponent: 2 for a pillow, 8 for a mattress with rounded edges.
    """
    width, depth, thickness = np.asarray(size, float)
    # Cosine spacing, because the height decreases steeply at the seam.
    line = -np.cos(np.linspace(0.0, math.pi, 17))
    x, y = np.meshgrid(line, -line)
    bulge = np.clip((1 - np.abs(x) ** exponent) * (1 - np.abs(y) ** exponent), 0.0, 1.0)
    height = thickness / 2 * np.sqrt(bulge)
    uv_m = np.stack([x * width / 2, -y * depth / 2], axis=-1)
    halves = []
    for sign in (1.0, -1.0):
        points = np.stack([x * width / 2, y * depth / 2 * sign, height * sign], axis=-1)
        points = points + np.asarray(base, float) + [0.0, 0.0, thickness / 2]
        halves.append(_grid(points, uv_m))
    return halves


def bent(patch: TexturedPatch, displace: Callable[[NDArray, NDArray], NDArray]) -> TexturedPatch:
    """Displace the points of a patch along its first normal by displace(u_m, v_m)."""
    normal = patch.normals()[0, 0]
    amount = displace(patch.uv_m[..., 0], patch.uv_m[..., 1])
    return replace(patch, points=patch.points + amount[..., None] * normal)


def fine_plate(
    corner: ArrayLike, right: ArrayLike, down: ArrayLike, cells: tuple[int, int]
) -> TexturedPatch:
    """Create a plate with a given number of cells (columns, rows), for use with `bent`."""
    right_vector, down_vector = np.asarray(right, float), np.asarray(down, float)
    s, t = np.meshgrid(np.linspace(0, 1, cells[0] + 1), np.linspace(0, 1, cells[1] + 1))
    points = np.asarray(corner, float) + s[..., None] * right_vector + t[..., None] * down_vector
    lengths = [np.linalg.norm(right_vector), np.linalg.norm(down_vector)]
    return _grid(points, np.stack([s, t], axis=-1) * lengths)


def placement(x: float, y: float, z: float = 0.0, yaw_rad: float = 0.0) -> NDArray[np.float64]:
    """Return the motion [4, 4] of a rotation about the vertical axis and a translation (metres)."""
    return se3.from_rotation_translation(
        se3.exp_so3(np.array([0.0, 0.0, yaw_rad])), np.array([x, y, z])
    )
