"""Viewpoints in a map without cameras: poses in free space that see its surfaces.

Neither the unit of length nor the vertical of such a map is known. Surfaces are therefore counted
in the cells of a grid whose size follows from the extent of the map, and rays are cast from the
free cells. The views are chosen one after the other, each for the surfaces that it adds. A surface
counts once for each distance (in octaves) from which it is seen, because features are matched over
a limited change of scale.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import rotation_matrices

Array = NDArray[np.float64]

# Number of cells along the longest side of the map.
_CELLS = 48
# The map without the outermost fraction of its Gaussians on each side, which may be far away.
_OUTSIDE = 0.02
# Gaussians of lower opacity are no surface; cells with a smaller sum of opacities are free.
_MIN_OPACITY, _MIN_SURFACE = 0.3, 0.6
# Minimum distance of a camera from surfaces, and step along a ray, in cells.
_CLEARANCE, _STEP = 4.0, 0.7
# Maximum number of positions, number of rays from each, and number of directions of views.
_POSITIONS, _RAYS, _DIRECTIONS = 300, 800, 32
# Minimum fraction of the rays of a view that meet a surface, and maximum fraction that do so within
# a number of cells: near views show little of the map, and a wall beside a camera is blurred.
_MIN_SEEN, _MAX_NEAR, _NEAR = 0.6, 0.4, 8
# Number of points of a Gaussian that represent its surface.
_POINTS = 7
# Larger Gaussians fill the whole map, and their points would exceed the range of cells.
_MAX_LOG_SCALE = 10.0
# Every further view of a surface at the same distance counts this times the one before.
_AGAIN = 0.5
# Surfaces are counted in blocks of so many cells.
_BLOCK = 3


def extent(cloud: GaussianCloud) -> float:
    """The longest side of a map without its outermost Gaussians, in its unit; 0 for none."""
    grid = _Grid.of(cloud)
    return 0.0 if grid is None else grid.size * _CELLS


def viewpoints(cloud: GaussianCloud, camera: Camera, count: int, up: Array | None = None) -> Array:
    """Choose poses T_map_camera [K, 4, 4] from which cameras see the surfaces of a map.

    Args:
        cloud: the map, in any unit of length.
        camera: intrinsics of the views.
        count: maximum number of poses.
        up: [3] the vertical of the map, which cameras are held upright in; None if unknown.

    Returns:
        The poses, those that see most first; none in a map without free space before surfaces.
    """
    grid = _Grid.of(cloud)
    if grid is None:
        return np.zeros((0, 4, 4))
    positions = grid.free_positions()
    rays = _sphere(_RAYS)
    views = _Views.cast(grid, positions, rays)
    axes = _sphere(_DIRECTIONS)
    half_angle = np.arctan(0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy))
    cones = axes @ rays.T >= np.cos(half_angle)
    poses = [
        _looking(positions[place], axes[axis], up) for place, axis in views.chosen(cones, count)
    ]
    return np.array(poses).reshape(-1, 4, 4)


@dataclass(frozen=True)
class _Grid:
    """Cells of a map.

    Attributes:
        low: [3] corner of the first cell.
        size: of a cell.
        occupied: [X, Y, Z] bool, cells with a surface.
    """

    low: Array
    size: float
    occupied: NDArray[np.bool_]

    @classmethod
    def of(cls, cloud: GaussianCloud) -> _Grid | None:
        """The grid of a map; None without opaque Gaussians or extent."""
        cloud = cloud.select(cloud.opacities >= _MIN_OPACITY)
        if len(cloud) == 0:
            return None
        means = cloud.means.double().numpy()
        low, high = np.quantile(means, (_OUTSIDE, 1.0 - _OUTSIDE), axis=0)
        size = float((high - low).max()) / _CELLS
        if size <= 0.0:
            return None
        shape = tuple(np.ceil((high - low) / size).astype(int) + 3)
        low = low - size
        total = np.zeros(int(np.prod(shape)))
        shares = cloud.opacities.double().numpy() / _POINTS
        for points in _surface_points(cloud):
            cells = np.floor((points - low) / size).astype(np.int64)
            inside = ((cells >= 0) & (cells < shape)).all(axis=1)
            flat = np.ravel_multi_index(tuple(cells[inside].T), shape)
            total += np.bincount(flat, shares[inside], minlength=len(total))
        return cls(low, size, (total >= _MIN_SURFACE).reshape(shape))

    def free_positions(self) -> Array:
        """Positions [P, 3] away from all surfaces, evenly spread."""
        distance = distance_transform_edt(~self.occupied)
        free = np.argwhere(distance >= _CLEARANCE)
        step = max(1, round((len(free) / _POSITIONS) ** (1.0 / 3.0)))
        spread = free[(free % step == step // 2).all(axis=1)]
        return np.asarray(self.low + (spread + 0.5) * self.size)


def _surface_points(cloud: GaussianCloud) -> Iterator[Array]:
    """A point [N, 3] of each Gaussian, `_POINTS` times: its centre, and both sides of each axis.

    The centres of large flat Gaussians alone would leave gaps in a wall.
    """
    means, shapes = cloud.means.double(), cloud.as_ellipsoids()
    scales = shapes.log_scales.double().clamp(max=_MAX_LOG_SCALE).exp()
    axes = rotation_matrices(shapes.rotations.double()) * scales[:, None]
    yield means.numpy()
    for axis in axes.unbind(2):
        yield (means + axis).numpy()
        yield (means - axis).numpy()


@dataclass(frozen=True)
class _Views:
    """What the rays from all positions meet.

    Attributes:
        seen: [P, R] number of the surface and of its distance, -1 for a ray that meets nothing.
        far: [P, R] bool, rays that meet no near surface.
        enclosed: [P] fraction of the rays that meet a surface.
    """

    seen: NDArray[np.int64]
    far: NDArray[np.bool_]
    enclosed: Array

    @classmethod
    def cast(cls, grid: _Grid, positions: Array, rays: Array) -> _Views:
        """Cast rays [R, 3] from positions [P, 3]."""
        shape = np.array(grid.occupied.shape)
        blocks = -(-shape // _BLOCK)
        seen = np.full((len(positions), len(rays)), -1, np.int64)
        far = np.ones(seen.shape, np.bool_)
        reach = int(np.linalg.norm(shape) / _STEP)
        for row, distant, position in zip(seen, far, positions, strict=True):
            start = (position - grid.low) / grid.size
            going = np.arange(len(rays))
            for step in range(1, reach):
                cells = np.floor(start + _STEP * step * rays[going]).astype(np.int64)
                inside = ((cells >= 0) & (cells < shape)).all(axis=1)
                going, cells = going[inside], cells[inside]
                met = grid.occupied[tuple(cells.T)]
                block = np.ravel_multi_index(tuple(cells[met].T // _BLOCK), blocks)
                octave = int(np.log2(_STEP * step + 1.0))
                row[going[met]] = block + octave * int(np.prod(blocks))
                distant[going[met]] = _STEP * step >= _NEAR
                going = going[~met]
                if len(going) == 0:
                    break
        return cls(seen, far, np.asarray((seen >= 0).mean(axis=1)))

    def chosen(self, cones: NDArray[np.bool_], count: int) -> list[tuple[int, int]]:
        """Position and direction of at most `count` views, one after the other the best.

        Args:
            cones: [A, R] the rays of each direction.
        """
        rows, shares = [], []
        for cone in cones:
            inside = self.seen[:, cone]
            share = (inside >= 0).mean(axis=1)
            usable = (share >= _MIN_SEEN) & (self.far[:, cone].mean(axis=1) >= 1.0 - _MAX_NEAR)
            rows.append(inside)
            shares.append(np.where(usable, share, 0.0) * self.enclosed)
        worth = np.ones(int(self.seen.max(initial=0)) + 2)
        worth[-1] = 0.0  # of rays that meet nothing
        found: list[tuple[int, int]] = []
        while len(found) < count:
            gains = [s * worth[row].mean(axis=1) for row, s in zip(rows, shares, strict=True)]
            axis = int(np.argmax([gain.max(initial=0.0) for gain in gains]))
            if gains[axis].max(initial=0.0) <= 0.0:
                break
            place = int(np.argmax(gains[axis]))
            shares[axis][place] = 0.0
            found.append((place, axis))
            seen = np.unique(rows[axis][place])
            worth[seen[seen >= 0]] *= _AGAIN
        return found


def _sphere(count: int) -> Array:
    """Directions [N, 3], evenly spread."""
    k = np.arange(count) + 0.5
    angle, z = np.pi * (1.0 + 5.0**0.5) * k, 1.0 - 2.0 * k / count
    around = np.sqrt(1.0 - z * z)
    return np.stack([around * np.cos(angle), around * np.sin(angle), z], axis=1)


def _looking(position: Array, forward: Array, up: Array | None) -> Array:
    """The pose [4, 4] of an upright camera that looks in a direction [3]."""
    T = np.eye(4)
    vertical = np.array([0.0, 0.0, 1.0]) if up is None else up
    right = np.cross(forward, vertical)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, np.roll(vertical, 1))
    right /= np.linalg.norm(right)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = position
    return T
