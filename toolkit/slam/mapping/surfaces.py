"""Surfaces of a map: planes through its Gaussians, which neighbours leave only together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.splatting.gaussians.cloud import GaussianCloud

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Array = NDArray[np.float64]

# Number of neighbours that a plane is fitted to, and that move together.
_NEIGHBOURS = 16
# Minimum cosine of the angle between the normals of neighbours on one surface.
_SAME_SURFACE = 0.8
# Maximum distance of a centre from where its neighbours moved to, in radii. Without a limit, the
# walls of a synthetic room are 18 mm thick, with it 5 mm, at 0.1 dB. If each centre kept to its own
# plane instead, surfaces could not move to where more views see them: 0.3 dB.
_OFF_SURFACE = 0.05


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Planes through N centres; neighbours on a surface leave them together.

    Attributes:
        centres: [N, 3] in metres.
        normals: [N, 3] unit normals of arbitrary sign; zero for unconstrained centres.
        limits_m: [N] maximum distances from the mean of the neighbours.
        neighbours: [N, N] weights of that mean of distances from the planes, None without planes.
    """

    centres: Tensor
    normals: Tensor
    limits_m: Tensor
    neighbours: csr_matrix | None

    @classmethod
    def of(cls, gaussians: GaussianCloud) -> Surfaces:
        """Fit planes to the neighbours of each centre; too few centres are unconstrained."""
        centres = gaussians.means.clone()
        points = centres.cpu().double().numpy()
        normals, neighbours = np.zeros_like(points), None
        if len(points) >= _NEIGHBOURS:
            o3d = open3d()
            cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
            normals = np.asarray(cloud.normals)
            neighbours = _means_of_neighbours(points, normals)
        limits_m = _OFF_SURFACE * gaussians.radii_m
        return cls(centres, torch.from_numpy(normals).to(centres), limits_m, neighbours)

    def off_m(self, centres: Tensor) -> Tensor:
        """Signed distances [N] of moved centres [N, 3] from where their neighbours moved to."""
        distance_m = ((centres - self.centres) * self.normals).sum(dim=1)
        if self.neighbours is None:
            return distance_m
        return distance_m - torch.from_numpy(self.neighbours @ distance_m.cpu().numpy()).to(centres)

    def keep(self, centres: Tensor) -> Tensor:
        """Move centres [N, 3] that are farther off than the limits back to these."""
        off_m = self.off_m(centres)
        excess_m = off_m - off_m.clamp(-self.limits_m, self.limits_m)
        return centres - excess_m[:, None] * self.normals


def _means_of_neighbours(points: Array, normals: Array) -> csr_matrix:
    """Weights [N, N] for the mean of the neighbours of N points on the same surface.

    Normals may point to either side: the sign of a weight tells whether those of two points agree.
    """
    # Not at the top: tracking and mapping of a few images run where only PyTorch is installed.
    from scipy.sparse import csr_matrix
    from scipy.spatial import KDTree

    index = KDTree(points).query(points, k=_NEIGHBOURS)[1]
    cosines = np.einsum("ijk,ik->ij", normals[index], normals)
    weights = np.where(np.abs(cosines) > _SAME_SURFACE, np.sign(cosines), 0.0)
    weights /= np.abs(weights).sum(axis=1, keepdims=True).clip(1.0)
    rows = np.arange(0, index.size + 1, _NEIGHBOURS)
    values = weights.astype(np.float32).ravel()
    return csr_matrix((values, index.ravel(), rows), shape=(len(points), len(points)))
