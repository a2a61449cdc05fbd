"""Local planes through the centres of Gaussians, which constrain the centres in refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toolkit.geometry.open3d_bridge import open3d

# Number of neighbours that a plane is fitted to. With 32, walls and renderings are equally good.
_NEIGHBOURS = 16


@dataclass(frozen=True, eq=False)
class Surfaces:
    """A plane through each of N centres.

    Attributes:
        centres: [N, 3] in metres.
        normals: [N, 3] unit normals of arbitrary sign; zero for unconstrained centres.
    """

    centres: Tensor
    normals: Tensor

    @classmethod
    def of(cls, centres: Tensor) -> Surfaces:
        """Fit planes to the neighbours of centres [N, 3]; too few centres are unconstrained."""
        normals = torch.zeros_like(centres)
        if len(centres) >= _NEIGHBOURS:
            o3d = open3d()
            points = o3d.utility.Vector3dVector(centres.cpu().double().numpy())
            cloud = o3d.geometry.PointCloud(points)
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
            normals = torch.from_numpy(np.asarray(cloud.normals)).to(centres)
        return cls(centres.clone(), normals)

    def project(self, centres: Tensor) -> Tensor:
        """Project moved centres [N, 3] onto their planes."""
        distance = ((centres - self.centres) * self.normals).sum(dim=1, keepdim=True)
        return centres - distance * self.normals
