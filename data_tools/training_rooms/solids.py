"""Labelled triangle meshes of simple solids, of which furniture is composed.

The world is z up, in metres. A solid rests on z = 0 unless a base is given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Point = tuple[float, float, float]

_CORNERS = np.array(
    [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 1.0)], dtype=np.float64
)
_FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
        [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ]
)  # fmt: skip


@dataclass(frozen=True)
class Solid:
    """A mesh of one class.

    Attributes:
        name: class name.
        vertices_m: [V, 3] float64.
        triangles: [T, 3] vertex indices.
        dark: absorbs or mirrors the light of depth sensors: glass, screens, steel.
    """

    name: str
    vertices_m: NDArray[np.float64]
    triangles: NDArray[np.int64]
    dark: bool = False


Piece = list[Solid]


def box(name: str, size: Point, base: Point = (0.0, 0.0, 0.0), dark: bool = False) -> Solid:
    """A box with sides along the axes; `base` is the centre of its lower side."""
    return Solid(name, _CORNERS * size + np.asarray(base), _FACES, dark)


def lathe(name: str, profile: list[tuple[float, float]], base: Point, sides: int = 12) -> Solid:
    """A solid of revolution; `profile` has pairs of radius and height from the bottom up."""
    angle = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rows = [np.column_stack([radius * ring, np.full(sides, z)]) for radius, z in profile]
    vertices = np.concatenate(rows) + np.asarray(base)
    return Solid(name, vertices, _tube(len(profile), sides))


def cylinder(name: str, radius: float, height: float, base: Point = (0.0, 0.0, 0.0)) -> Solid:
    """An upright cylinder."""
    return lathe(name, [(0.0, 0.0), (radius, 0.0), (radius, height), (0.0, height)], base)


def rounded(name: str, size: Point, base: Point = (0.0, 0.0, 0.0), power: float = 2.0) -> Solid:
    """A superellipsoid: an ellipsoid at power 2, towards a box at higher ones."""
    rows, sides = 9, 16
    latitude = np.linspace(-np.pi / 2, np.pi / 2, rows)[:, None]
    longitude = np.linspace(0.0, 2.0 * np.pi, sides, endpoint=False)[None]
    x = _powered(np.cos(latitude), power) * _powered(np.cos(longitude), power)
    y = _powered(np.cos(latitude), power) * _powered(np.sin(longitude), power)
    z = np.broadcast_to(_powered(np.sin(latitude), power), x.shape)
    unit = np.stack([x, y, z + 1.0], axis=-1).reshape(-1, 3) / 2.0
    return Solid(name, unit * size + np.asarray(base), _tube(rows, sides))


def sheet(name: str, points: NDArray[np.float64], dark: bool = False) -> Solid:
    """A surface through a grid of points [R, C, 3]."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    first = np.stack([a, d, c], axis=-1).reshape(-1, 3)
    second = np.stack([a, c, b], axis=-1).reshape(-1, 3)
    return Solid(name, points.reshape(-1, 3), np.concatenate([first, second]), dark)


def placed(
    piece: Piece, at: Point = (0.0, 0.0, 0.0), yaw_rad: float = 0.0, scale: float = 1.0
) -> Piece:
    """A copy of the piece, scaled, turned about z, then moved."""
    cos, sin = scale * np.cos(yaw_rad), scale * np.sin(yaw_rad)
    matrix = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, scale]])
    return transformed(piece, matrix, at)


def tilted(piece: Piece, pitch_rad: float, at: Point = (0.0, 0.0, 0.0)) -> Piece:
    """A copy turned about the x axis, then moved; positive angles lean to the front, -y."""
    cos, sin = np.cos(pitch_rad), np.sin(pitch_rad)
    return transformed(piece, np.array([[1.0, 0, 0], [0, cos, -sin], [0, sin, cos]]), at)


def transformed(piece: Piece, matrix: NDArray[np.float64], at: Point) -> Piece:
    """A copy of the piece under a linear map [3, 3] and a translation."""
    return [
        Solid(s.name, s.vertices_m @ matrix.T + np.asarray(at), s.triangles, s.dark) for s in piece
    ]


def extent(piece: Piece) -> NDArray[np.float64]:
    """The lowest and highest corner [2, 3] of the piece."""
    points = np.concatenate([solid.vertices_m for solid in piece])
    return np.stack([points.min(axis=0), points.max(axis=0)])


def _powered(values: NDArray[np.float64], power: float) -> NDArray[np.float64]:
    return np.sign(values) * np.abs(values) ** (2.0 / power)


def _tube(rows: int, sides: int) -> NDArray[np.int64]:
    """Triangles [T, 3] between `rows` closed rings of `sides` points."""
    row, side = np.meshgrid(np.arange(rows - 1), np.arange(sides), indexing="ij")
    following = (side + 1) % sides
    a, b = row * sides + side, row * sides + following
    c, d = a + sides, b + sides
    first, second = np.stack([a, b, d], axis=-1), np.stack([a, d, c], axis=-1)
    return np.concatenate([first.reshape(-1, 3), second.reshape(-1, 3)])
