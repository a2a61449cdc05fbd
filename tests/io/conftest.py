"""Gaussians that are written to files."""

from dataclasses import replace

import pytest
import torch

from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids


@pytest.fixture
def cloud() -> GaussianCloud:
    g = torch.Generator().manual_seed(0)
    n = 50
    return GaussianCloud.from_values(
        means=torch.randn(n, 3, generator=g),
        radii_m=0.001 + 0.05 * torch.rand(n, generator=g),
        opacities=0.05 + 0.9 * torch.rand(n, generator=g),
        colours=torch.rand(n, 3, generator=g),
    )


@pytest.fixture
def ellipsoids(cloud) -> GaussianCloud:
    """Ellipsoids with harmonics of degree 2 that a byte can store."""
    generator = torch.Generator().manual_seed(3)
    count = len(cloud)
    shapes = Ellipsoids(
        cloud.log_radii[:, None] + torch.rand(count, 3, generator=generator) - 0.5,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1),
        0.4 * torch.rand(count, 8, 3, generator=generator) - 0.2,
    )
    return replace(cloud, ellipsoids=shapes, log_radii=shapes.log_scales.mean(dim=1))
