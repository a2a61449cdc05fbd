"""Merging of Gaussians for coarse levels of detail, with matched moments.

Merged Gaussians have the mean, the covariance and the colour of those that they replace. What they
cover is conserved as well: opacity times projected area, as far as opacities below 1 allow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.tools.viewer.scene import ShownSplats

# Maximum opacity of merged Gaussians, and the factor by which their variances grow where that is
# not enough: they stand for Gaussians that overlap, and surfaces must remain closed.
_MAX_OPACITY = 0.99
_MAX_VARIANCE_GROWTH = 3.0
_SMALLEST_M = 1e-6
_SMALLEST_MASS = 1e-30
# Columns that are those of one of the merged Gaussians, because their values have no mean.
_NAMES = ("levels", "submap", "inferred")
_ROWS, _COLUMNS = np.triu_indices(3)


@dataclass(frozen=True)
class Moments:
    """Sums of Gaussians, from which they can be merged further.

    Attributes:
        mass: [N] float64 opacity times mean projected area, in square metres.
        means_m: [N, 3] float64.
        covariances: [N, 6] float64 in square metres, as xx, xy, xz, yy, yz, zz.
        values: [N, C] float32 with means: red, green, blue, confidence and harmonics, as present.
        names: [N] columns without a mean, by name. Merged Gaussians take those of one with the
            class that has the largest mass.
    """

    mass: NDArray[np.float64]
    means_m: NDArray[np.float64]
    covariances: NDArray[np.float64]
    values: NDArray[np.float32]
    names: dict[str, NDArray]

    def __len__(self) -> int:
        return len(self.mass)

    @property
    def sizes_m(self) -> NDArray[np.float64]:
        """Sizes [N]: standard deviations of spheres with the same projected area."""
        return np.sqrt(_area_m2(self.covariances))

    @classmethod
    def of(cls, splats: ShownSplats) -> Moments:
        """Return the moments of Gaussians."""
        variances = splats.sigmas_m.astype(np.float64)[:, None] ** 2
        shapes = np.eye(3)[_ROWS, _COLUMNS] if splats.shapes is None else splats.shapes
        covariances = variances * shapes
        columns = [splats.rgb.astype(np.float32)]
        if splats.confidence is not None:
            columns.append(splats.confidence[:, None])
        if splats.harmonics is not None:
            columns.append(splats.harmonics.reshape(len(splats), -1).astype(np.float32))
        return cls(
            np.maximum(splats.opacities * _area_m2(covariances), _SMALLEST_MASS),
            splats.means_m.astype(np.float64),
            covariances,
            np.concatenate(columns, axis=1),
            {name: a for name, a in splats.columns().items() if name in _NAMES},
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Moments]) -> Moments:
        """Concatenate in order."""
        return cls(
            np.concatenate([part.mass for part in parts]),
            np.concatenate([part.means_m for part in parts]),
            np.concatenate([part.covariances for part in parts]),
            np.concatenate([part.values for part in parts]),
            {name: np.concatenate([p.names[name] for p in parts]) for name in parts[0].names},
        )

    def merged(self, groups: NDArray[np.intp]) -> Moments:
        """Return one Gaussian for each group that occurs, in their order.

        Args:
            groups: [N] number of the group of each Gaussian.
        """
        classes = self._classes()
        keys = groups * (int(classes.max()) + 1) + classes
        order = np.argsort(keys, kind="stable")
        member, weights = groups[order], self.mass[order]
        starts = np.flatnonzero(np.diff(member, prepend=-1))
        sizes = np.diff(starts, append=len(order))
        mass = np.add.reduceat(weights, starts)

        def mean(columns: NDArray) -> NDArray:
            return np.add.reduceat(columns * weights[:, None], starts, axis=0) / mass[:, None]

        means_m = mean(self.means_m[order])
        offsets_m = self.means_m[order] - np.repeat(means_m, sizes, axis=0)
        spread = offsets_m[:, _ROWS] * offsets_m[:, _COLUMNS]
        # Of the Gaussians of one class in a group, which follow each other, the first.
        parts = np.flatnonzero(np.diff(keys[order], prepend=-1))
        of_class = np.add.reduceat(weights, parts)
        ranked = parts[np.lexsort((-of_class, member[parts]))]
        kept = order[ranked[np.flatnonzero(np.diff(member[ranked], prepend=-1))]]
        return Moments(
            mass,
            means_m,
            mean(self.covariances[order] + spread),
            mean(self.values[order]).astype(np.float32),
            {name: column[kept] for name, column in self.names.items()},
        )

    def _classes(self) -> NDArray[np.intp]:
        """Return the class [N] of each Gaussian, its node at the finest level, as numbers >= 0."""
        levels = self.names.get("levels")
        if levels is None or not levels.shape[1]:
            return np.zeros(len(self), np.intp)
        return levels[:, -1].astype(np.intp) + 1

    def shown(self, like: ShownSplats) -> ShownSplats:
        """Return the Gaussians with opacities and sizes for which surfaces are closed.

        Args:
            like: Gaussians with the same columns.
        """
        needed = self.mass / np.maximum(_area_m2(self.covariances), _SMALLEST_M**2)
        growth = (needed / _MAX_OPACITY).clip(1.0, _MAX_VARIANCE_GROWTH)
        covariances = self.covariances * growth[:, None]
        sigmas_m = np.maximum(_determinants(covariances), _SMALLEST_M**6) ** (1.0 / 6.0)
        columns: dict[str, NDArray] = {
            "means_m": self.means_m.astype(np.float32),
            "sigmas_m": sigmas_m.astype(np.float32),
            "opacities": needed.clip(0.0, _MAX_OPACITY).astype(np.float32),
            "rgb": np.rint(self.values[:, :3]).astype(np.uint8),
            "shapes": (covariances / sigmas_m[:, None] ** 2).astype(np.float32),
        }
        if like.confidence is not None:
            columns["confidence"] = self.values[:, 3]
        if like.harmonics is not None:
            count = like.harmonics.shape[1]
            steps = np.rint(self.values[:, -3 * count :]).astype(np.int8)
            columns["harmonics"] = steps.reshape(-1, count, 3)
        return ShownSplats(**columns, **self.names)


def _area_m2(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the projected area [N] of covariances [N, 6], about the mean over all directions.

    The area of a sphere of standard deviation s counts as s^2.
    """
    xx, xy, xz, yy, yz, zz = covariances.T
    minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
    areas_m2: NDArray[np.float64] = np.sqrt(np.maximum(minors, 0.0) / 3.0)
    return areas_m2


def _determinants(covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    xx, xy, xz, yy, yz, zz = covariances.T
    determinants: NDArray[np.float64] = (
        xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz)
    )
    return determinants
