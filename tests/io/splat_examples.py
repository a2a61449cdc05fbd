"""Splats for tests of file formats."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.harmonics import HARMONIC_COUNTS
from toolkit.io.splat_labels import SplatLabels
from toolkit.io.splat_placement import SplatScene
from toolkit.io.splats import Splats
from toolkit.splatting.gaussians.cloud import PIXEL_FILTER, GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering import render

COUNT = 40
# A floor that is not level in the frame of the map, far from the origin.
TILTED = se3.exp(np.array([3e5, 4e6, 57.0, 0.3, -0.7, 1.1]))
# Neither names nor nodes are in alphabetical order.
TREE = {
    "name": "tree",
    "levels": ["group", "class"],
    "classes": ["chair", "Tür"],
    "tree": {"seating": {"chair": {}}, "building": {"Tür": {}}},
}
NOTES = SplatScene(comments=("origin_m 1 2 3", "a note"), taxonomy=TREE)


def spheres() -> GaussianCloud:
    """Colours outside [0, 1] as well."""
    g = torch.Generator().manual_seed(0)
    return GaussianCloud.from_values(
        means=0.5 * torch.randn(COUNT, 3, generator=g),
        radii_m=0.02 + 0.05 * torch.rand(COUNT, generator=g),
        opacities=0.05 + 0.9 * torch.rand(COUNT, generator=g),
        colours=1.2 * torch.rand(COUNT, 3, generator=g) - 0.1,
    )


def ellipsoids(degree: int) -> GaussianCloud:
    g = torch.Generator().manual_seed(3)
    cloud = spheres()
    shapes = Ellipsoids(
        cloud.log_radii[:, None] + torch.rand(COUNT, 3, generator=g) - 0.5,
        torch.nn.functional.normalize(torch.randn(COUNT, 4, generator=g), dim=1),
        0.4 * torch.rand(COUNT, HARMONIC_COUNTS[degree], 3, generator=g) - 0.2,
    )
    means = shapes.log_scales.mean(dim=1)
    return replace(cloud, ellipsoids=shapes, log_radii=means, low_pass=PIXEL_FILTER)


def labels() -> SplatLabels:
    generator = np.random.default_rng(0)
    return SplatLabels(
        label=generator.integers(0, 550, COUNT).astype(np.int32),
        levels=generator.integers(-1, 40_000, (COUNT, 11)).astype(np.int32),
        confidence=generator.uniform(0, 1, COUNT).astype(np.float32),
    )


def assert_same_splats(read: Splats, written: GaussianCloud) -> None:
    np.testing.assert_array_equal(read.means, written.means.numpy())
    np.testing.assert_allclose(read.log_radii, written.log_radii.numpy(), atol=1e-6)
    np.testing.assert_allclose(read.opacity_logits, written.opacity_logits.numpy(), atol=1e-5)
    np.testing.assert_allclose(read.colours, written.colours.numpy(), atol=1e-6)
    shapes = written.ellipsoids
    assert (read.ellipsoids is None) == (shapes is None)
    if shapes is not None:
        assert read.pixel_filter
        for name, tensor in shapes.tensors().items():
            values = getattr(read.ellipsoids, name)
            np.testing.assert_allclose(values, tensor.numpy(), atol=1e-6, err_msg=name)


def assert_same_labels(read: SplatLabels | None, written: SplatLabels) -> None:
    assert read is not None
    for name in ("label", "levels", "confidence"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name))


def image_of(cloud: GaussianCloud) -> torch.Tensor:
    """The map from the side, where harmonics and axes matter."""
    camera = Camera(40.0, 40.0, 15.5, 15.5, 32, 32)
    T_camera_map = se3.exp(np.array([0.2, 0.1, 2.5, 0.3, 0.8, -0.4]))
    return render(cloud, camera, T_camera_map).colour


def one_line(error: Exception, path: Path) -> bool:
    """Whether a message is a line that names the file and ends with a remedy."""
    text = str(error)
    return str(path) in text and "\n" not in text and (";" in text or "pip install" in text)
