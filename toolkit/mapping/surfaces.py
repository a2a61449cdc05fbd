"""The surfaces that centres lie on, so that a refinement of colours leaves them there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from toolkit.geometry.open3d_bridge import open3d

# Centres that a surface is told from. With 32 instead, walls and views are the same.
_NEIGHBOURS = 16


@dataclass(frozen=True, eq=False)
class Surfaces:
    """A plane through each of N centres.

    Attributes:
        centres: [N, 3], m.
        normals: [N, 3], units, of either sign.
    """

    centres: Tensor
    normals: Tensor

    @classmethod
    def of(cls, centres: Tensor) -> Surfaces:
        """Planes through centres [N, 3] along their neighbours; free where these are too few."""
        normals = torch.zeros_like(centres)
        if len(centres) >= _NEIGHBOURS:
            o3d = open3d()
            points = o3d.utility.Vector3dVector(centres.cpu().double().numpy())
            cloud = o3d.geometry.PointCloud(points)
            cloud.estimate_normals(o3d.geometry.KDTreeSearchParamKNN(_NEIGHBOURS))
            normals = torch.from_numpy(np.asarray(cloud.normals)).to(centres)
        return cls(centres.clone(), normals)

    def nearest(self, centres: Tensor) -> Tensor:
        """Where moved centres [N, 3] come to lie when each is put back on its plane."""
        off = ((centres - self.centres) * self.normals).sum(dim=1, keepdim=True)
        return centres - off * self.normals
