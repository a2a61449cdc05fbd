"""Axes and view-dependent colours, with which a cloud consists of ellipsoids.

Parameters, signs of the harmonics and order of the quaternion are those of 3DGS and its files.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.harmonics import HARMONIC_COUNTS, harmonic_rotation, harmonics

# The tensors of ellipsoids, one row for each.
SHAPES = ("log_scales", "rotations", "harmonics")


@dataclass(frozen=True)
class Ellipsoids:
    """Shapes and view dependence of N Gaussians.

    Attributes:
        log_scales: [N, 3] float32, natural logarithms of the standard deviations along the axes,
            in metres.
        rotations: [N, 4] float32, quaternions wxyz of any length > 0, from axes to map.
        harmonics: [N, K, 3] float32, coefficients of the spherical harmonics of the degrees 1 to
            3 (K is 0, 3, 8 or 15), added to the colour.

    Raises:
        ValueError: shapes do not match.
    """

    log_scales: Tensor
    rotations: Tensor
    harmonics: Tensor

    def __post_init__(self) -> None:
        n, K = len(self.log_scales), self.harmonics.shape[1]
        expected = {"log_scales": (n, 3), "rotations": (n, 4), "harmonics": (n, K, 3)}
        for name, shape in expected.items():
            actual = tuple(getattr(self, name).shape)
            if actual != shape:
                raise ValueError(f"{name} must have shape {list(shape)}, got {list(actual)}")
        if K not in HARMONIC_COUNTS:
            raise ValueError(f"harmonics must have 0, 3, 8 or 15 coefficients, got {K}")

    def __len__(self) -> int:
        return len(self.log_scales)

    @property
    def degree(self) -> int:
        """Highest degree of the harmonics, 0 to 3."""
        return HARMONIC_COUNTS.index(self.harmonics.shape[1])

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by name."""
        return {name: getattr(self, name) for name in SHAPES}

    def mapped(self, function: Callable[[Tensor], Tensor]) -> Ellipsoids:
        """Apply a function of rows to all tensors."""
        return Ellipsoids(*map(function, self.tensors().values()))

    def rotated(self, R: NDArray[np.float64]) -> Ellipsoids:
        """Return the ellipsoids after a rotation [3, 3] of the map, with their view dependence."""
        w, x, y, z = quaternions(R[None])[0]
        product = ((w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w))
        turned = torch.from_numpy(harmonic_rotation(R, self.harmonics.shape[1]))
        return Ellipsoids(
            self.log_scales,
            self.rotations @ self.rotations.new_tensor(product).T,
            torch.einsum("jk,nkc->njc", turned.to(self.harmonics), self.harmonics),
        )

    def with_degree(self, degree: int) -> Ellipsoids:
        """Return the ellipsoids with harmonics of another degree: cut, or filled with zeros."""
        K = HARMONIC_COUNTS[degree]
        kept = self.harmonics[:, :K]
        filled = torch.cat([kept, kept.new_zeros(len(self), K - kept.shape[1], 3)], dim=1)
        return Ellipsoids(self.log_scales, self.rotations, filled)

    @classmethod
    def concatenate(cls, parts: Sequence[Ellipsoids]) -> Ellipsoids:
        """Concatenate in order, with the highest degree of all."""
        degree = max(part.degree for part in parts)
        parts = [part.with_degree(degree) for part in parts]
        return cls(*(torch.cat([getattr(part, name) for part in parts]) for name in SHAPES))

    @classmethod
    def spheres(cls, log_radii: Tensor, degree: int = 0) -> Ellipsoids:
        """Spheres [N] as ellipsoids, whose colour does not depend on the view."""
        n = len(log_radii)
        rotations = log_radii.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(n, 4).contiguous()
        scales = log_radii[:, None].expand(n, 3).contiguous()
        return cls(scales, rotations, log_radii.new_zeros(n, HARMONIC_COUNTS[degree], 3))


def quaternions(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions [N, 4], wxyz, of rotation matrices [N, 3, 3]."""
    a, b, c = R[:, 0, 0], R[:, 1, 1], R[:, 2, 2]
    x, y, z = R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]
    xy, xz, yz = R[:, 0, 1] + R[:, 1, 0], R[:, 0, 2] + R[:, 2, 0], R[:, 1, 2] + R[:, 2, 1]
    # Each row is the quaternion times one of its entries; the largest entry is the most precise.
    rows = np.array(
        [
            [1 + a + b + c, x, y, z],
            [x, 1 + a - b - c, xy, xz],
            [y, xy, 1 - a + b - c, yz],
            [z, xz, yz, 1 - a - b + c],
        ]
    )
    largest = rows[np.arange(4), np.arange(4)].argmax(axis=0)
    chosen = rows[largest, :, np.arange(len(R))]
    return np.asarray(chosen / np.linalg.norm(chosen, axis=1, keepdims=True))


def rotation_matrices(quaternions: Tensor) -> Tensor:
    """Rotation matrices [N, 3, 3] of quaternions [N, 4], wxyz, of any length > 0."""
    w, x, y, z = torch.nn.functional.normalize(quaternions, dim=1).unbind(1)
    rows = (
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], dim=1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], dim=1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], dim=1),
    )
    return torch.stack(rows, dim=1)


def harmonic_basis(directions: Tensor, count: int) -> Tensor:
    """Values [N, K] of the first K = `count` harmonics after the constant.

    Args:
        directions: [N, 3] from the camera to the Gaussians, of length 1.
    """
    values = harmonics(*directions.unbind(1))
    return torch.stack(values[:count], dim=1) if count else directions[:, :0]
