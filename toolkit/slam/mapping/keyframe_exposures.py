"""Exposure and white balance of keyframes relative to the first one, the reference of the map.

The images of keyframes are compared with each other, not with the map: a map is smoother than its
images and follows slow changes of them, so that differences to it stay small while it fades and
its colours drift. See `exposure` and `white_balance` of `toolkit.splatting.alignment` for the
estimates.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.exposure import IDENTITY, NEUTRAL, Exposure
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe, evenly_spaced, fractions_observed
from toolkit.base.native import address, kernels
from toolkit.splatting.alignment.exposure import exposure_between_images
from toolkit.splatting.alignment.reference import LUMA
from toolkit.splatting.alignment.white_balance import (
    MIN_COLOUR,
    BalanceDifference,
    BalanceLink,
    balance_difference,
    balance_gains,
    is_neutral,
    solve_balances,
)

Array = NDArray[np.float64]

# Colours are compared at about this number of cells per row; averages contain little noise and
# are robust against small errors of poses.
_CELLS_PER_ROW = 80
# Level of 8 bits from which a channel may be saturated.
_SATURATED = 250
# Maximum difference of the depths of a surface in two keyframes, as a fraction of depth.
_SAME_SURFACE = 0.05
# Minimum cosine of the angle at which two keyframes see a point. The two sides of a thin wall
# differ in colour, and shiny surfaces look different from elsewhere.
_MIN_COSINE = 0.5
# Minimum fraction of a keyframe's points that an earlier one measured.
_MIN_OVERLAP = 0.2
# Maximum number of earlier keyframes whose overlap is computed; limits time in large maps.
_MAX_CANDIDATES = 32
_CACHED = 64
# Maximum numbers of the newest and of other overlapping keyframes that a keyframe is compared with.
_RECENT, _OLDER = 3, 4
# Minimum change of a channel's gain that is applied, as a fraction. Where the white balance is
# constant, the estimates change by 0.1 % in a room with sensor noise, and by 0.5 % in a ring of
# rooms.
_MIN_CHANGE = 0.01
# The white balance of a camera changes slowly.
_UNCHANGED = BalanceDifference(np.zeros(3), 0.01)


@dataclass(frozen=True)
class _Cells:
    """Colours of a keyframe at a lower resolution.

    Attributes:
        size: width of a cell in pixels.
        colours: [h, w, 3] float32 mean colours as observed, 0 in cells with saturated pixels.
        points: [P, 3] measured points at the centres of cells, in camera coordinates.
        of_points: [P, 3] colours of their cells.
        mean: [3] mean colour of the image.
    """

    size: int
    colours: NDArray[np.float32]
    points: Array
    of_points: NDArray[np.float32]
    mean: Array

    @classmethod
    def of(cls, keyframe: Keyframe) -> _Cells:
        """Divide the images of a keyframe into cells."""
        size = max(1, round(keyframe.camera.width / _CELLS_PER_ROW))
        height, width = (length // size for length in keyframe.depth_m.shape)
        rgb = keyframe.rgb.numpy()[:, : height * size, : width * size]
        # The pixels at the same place of all cells; reductions over short axes are slow.
        places = [rgb[:, j::size, i::size] for j in range(size) for i in range(size)]
        sums = functools.reduce(np.add, places, np.zeros((3, height, width), np.float32))
        brightest = functools.reduce(np.maximum, places).max(axis=0)
        planes = sums / np.float32(255.0 * size * size)
        mean = planes.reshape(3, -1).mean(axis=1, dtype=np.float64)
        colours = np.ascontiguousarray(planes.transpose(1, 2, 0))
        colours[brightest >= _SATURATED] = 0.0
        rows, columns = np.arange(height) * size, np.arange(width) * size
        depth_m = keyframe.measured_m.numpy()[np.ix_(rows + size // 2, columns + size // 2)]
        used = (depth_m > 0) & (colours > 0).all(axis=-1)
        camera, centre = keyframe.camera, 0.5 * (size - 1)
        x = (columns[None] + centre - camera.cx) / camera.fx * depth_m
        y = (rows[:, None] + centre - camera.cy) / camera.fy * depth_m
        points = np.stack([x, y, depth_m], axis=-1).astype(np.float64)[used]
        return cls(size, colours, points, colours[used], mean)


@dataclass(frozen=True)
class _Common:
    """Colours as observed [P, 3] of the same surfaces in an earlier and a new keyframe."""

    old: NDArray[np.float32]
    new: NDArray[np.float32]

    def difference(self, old: Exposure, new: Exposure) -> BalanceDifference | None:
        """Difference of the white balances of keyframes with known gains and biases."""
        # A large gain does not make the hue of a dark channel any better.
        red, green, blue = np.minimum(self.old, self.new).T >= MIN_COLOUR
        bright = red & green & blue
        return balance_difference(
            _with_gain(old, self.old[bright]), _with_gain(new, self.new[bright])
        )


class KeyframeExposures:
    """Estimates exposures of keyframes; caches the cells of the last ones compared.

    Args:
        white_balance: estimate the white balance of keyframes.
        gains: estimate gain and bias of new keyframes.
    """

    def __init__(self, white_balance: bool = True, gains: bool = True) -> None:
        self.white_balance, self.gains = white_balance, gains
        self._cache: LruCache[_Cells] = LruCache(_CACHED)

    def estimate(self, keyframe: Keyframe, others: Sequence[Keyframe]) -> None:
        """Set the exposure and the white balance of a new keyframe.

        Args:
            keyframe: at its pose; it changes. Where too few surfaces determine gain and bias,
                its own remain.
            others: keyframes of the same map, in order. Without any, the keyframe is a reference
                and stays as it is.
        """
        use = self.gains or self.white_balance
        chosen = self._chosen(keyframe, others) if use else []
        if not chosen:
            return
        common = [self._common(other, keyframe) for other in chosen]
        if self.gains:
            # Near that of the newest one; a relocalised keyframe has none yet.
            balance = chosen[-1].exposure.balance
            keyframe.exposure = keyframe.exposure.with_balance(balance)
            self._set_gain(keyframe, chosen, common)
        if not self.white_balance:
            return
        keyframe.balance_links = _links(chosen, keyframe, common)
        known = np.array([_log_balance(k) for k in chosen])
        values = solve_balances(known, len(chosen) + 1, _numbered([*chosen, keyframe]))
        self._set_balance(keyframe, values[-1], is_neutral(values[-1], _MIN_CHANGE))
        if self.gains:
            # The white balance changes the intensities of coloured surfaces.
            self._set_gain(keyframe, chosen, common)

    def adjust(self, keyframes: Sequence[Keyframe]) -> None:
        """Set the white balance of all keyframes but the first jointly.

        It stays neutral if that of no keyframe differs enough.
        """
        if not self.white_balance or len(keyframes) < 2:
            return
        known = _log_balance(keyframes[0])[None]
        values = solve_balances(known, len(keyframes), _numbered(keyframes))
        neutral = is_neutral(values, _MIN_CHANGE)
        for keyframe, value in zip(keyframes[1:], values[1:], strict=True):
            self._set_balance(keyframe, value, neutral)

    def _chosen(self, new: Keyframe, others: Sequence[Keyframe]) -> list[Keyframe]:
        """Earlier keyframes that show the same surfaces: the newest ones, and evenly spaced others.

        The others close loops within a map, which bounds the drift there.
        """
        newest = max(len(others) - _RECENT, 0)
        candidates = [*evenly_spaced(others[:newest], _MAX_CANDIDATES), *others[newest:]]
        if not candidates:
            return []
        observed = fractions_observed(candidates, new.points_in_map())
        near = [k for k, f in zip(candidates, observed, strict=True) if f >= _MIN_OVERLAP]
        return [*evenly_spaced(near[:-_RECENT], _OLDER), *near[-_RECENT:]]

    def _common(self, old: Keyframe, new: Keyframe) -> _Common:
        """Colours of two keyframes where both measured the same surface."""
        cells, own = self._cells(old), self._cells(new)
        T_old_new = se3.inverse(old.T_map_camera) @ new.T_map_camera
        numbers = _common_cells(old, cells.size, own.points, T_old_new)
        same = numbers >= 0
        # No interpolation, which would smooth one of the images: the pair would not be symmetric.
        return _Common(cells.colours.reshape(-1, 3)[numbers[same]], own.of_points[same])

    @staticmethod
    def _set_gain(new: Keyframe, chosen: Sequence[Keyframe], common: Sequence[_Common]) -> None:
        reference = [
            other.exposure.apply(pair.old) @ LUMA
            for other, pair in zip(chosen, common, strict=True)
        ]
        balance = IDENTITY.with_balance(new.exposure.balance)
        image = np.concatenate([balance.apply(pair.new) @ LUMA for pair in common])
        found = exposure_between_images(np.concatenate(reference), image)
        if found is not None:
            new.exposure = found.with_balance(new.exposure.balance)

    def _set_balance(self, keyframe: Keyframe, log_balance: Array, neutral: bool) -> None:
        keyframe.log_balance = log_balance
        exposure, mean = keyframe.exposure, self._cells(keyframe).mean
        balance = NEUTRAL if neutral else balance_gains(log_balance, _with_gain(exposure, mean))
        keyframe.exposure = exposure.with_balance(balance)

    def _cells(self, keyframe: Keyframe) -> _Cells:
        return self._cache.get(keyframe.index, lambda: _Cells.of(keyframe))


def _links(chosen: Sequence[Keyframe], new: Keyframe, common: Sequence[_Common]) -> Array:
    """Differences of white balance between a new keyframe and earlier ones; see `Keyframe`."""
    found = [
        (old.index, pair.difference(old.exposure, new.exposure))
        for old, pair in zip(chosen, common, strict=True)
    ]
    # Where no colours determine the balance, it stays as it was.
    found.append((chosen[-1].index, _UNCHANGED))
    return np.array([[index, *d.log_gains, d.weight] for index, d in found if d is not None])


def _numbered(keyframes: Sequence[Keyframe]) -> list[BalanceLink]:
    """The links among some keyframes, which have their positions as numbers."""
    numbers = {keyframe.index: number for number, keyframe in enumerate(keyframes)}
    return [
        BalanceLink(numbers[int(link[0])], number, BalanceDifference(link[1:4], float(link[4])))
        for number, keyframe in enumerate(keyframes)
        if keyframe.balance_links is not None
        for link in keyframe.balance_links
        if int(link[0]) in numbers
    ]


def _with_gain(exposure: Exposure, colours: NDArray) -> NDArray:
    """Colours with the gain and bias of an exposure, without its white balance."""
    return exposure.with_balance(NEUTRAL).apply(colours)


def _common_cells(old: Keyframe, size: int, points: Array, T_old_new: Array) -> NDArray[np.int32]:
    """Cells [P] of a keyframe that measured the same surfaces as a newer one; -1 for none.

    Args:
        size: width of a cell in pixels.
        points: [P, 3] measured by the newer keyframe, in its camera's coordinates.
        T_old_new: [4, 4].
    """
    module = kernels()
    if module is None:
        return _common_cells_numpy(old, size, points, T_old_new)
    camera, depth_m = old.camera, old.measured_m
    cells = np.empty(len(points), np.int32)
    module.find_common_cells(
        points.ctypes.data,
        len(points),
        T_old_new[:3].ravel(),
        (camera.fx, camera.fy, camera.cx, camera.cy),
        (camera.width, camera.height),
        address(depth_m),
        size,
        (_SAME_SURFACE, _MIN_COSINE),
        cells.ctypes.data,
    )
    return cells


def _common_cells_numpy(
    old: Keyframe, size: int, points: Array, T_old_new: Array
) -> NDArray[np.int32]:
    """As `_common_cells`, in NumPy: reference and fallback of the native kernel."""
    camera = old.camera
    points = se3.transform_points(T_old_new, points)
    ahead = points[:, 2] > 0
    uv = camera.project(np.where(ahead[:, None], points, [0.0, 0.0, 1.0]))
    cell = np.floor((uv + 0.5) / size).astype(np.int32)
    columns, rows = camera.width // size, camera.height // size
    inside = ahead & (cell >= 0).all(axis=1) & (cell < (columns, rows)).all(axis=1)
    at = np.rint(uv[inside]).astype(np.intp)
    depth_m, z = old.measured_m.numpy()[at[:, 1], at[:, 0]], points[inside, 2]
    same = np.abs(z - depth_m) < _SAME_SURFACE * depth_m
    same &= _cosines(points[inside], T_old_new[:3, 3]) > _MIN_COSINE
    inside[inside] = same
    return np.where(inside, cell[:, 1] * columns + cell[:, 0], -1).astype(np.int32)


def _cosines(points: Array, centre: Array) -> Array:
    """Cosines [P] of the angles at which the origin and another centre [3] see points [P, 3]."""
    others = points - centre
    lengths = np.linalg.norm(points, axis=1) * np.linalg.norm(others, axis=1)
    return np.asarray((points * others).sum(axis=1) / np.maximum(lengths, 1e-9))


def _log_balance(keyframe: Keyframe) -> Array:
    return np.zeros(3) if keyframe.log_balance is None else keyframe.log_balance
