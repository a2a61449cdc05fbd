"""The Triton kernels as a backend of the CPU, for comparison with the others.

On a GPU where there is one, else through Triton's interpreter (see tests/conftest.py), which
runs the same source in Python: slow, so scenes are small.
"""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from splat_scenes import (
    Scene,
    assert_same_gradients,
    assert_same_images,
    exact,
    gradients_of,
    reference_images,
)
from torch import Tensor

from toolkit.splatting.rendering import GaussianGradients
from toolkit.splatting.rendering.backend import ForwardPass
from toolkit.splatting.rendering.reference import ReferenceBackend

pytest.importorskip("triton", reason="triton is not installed")

from toolkit.splatting.rendering.cuda.backend import CudaRenderer, interpreted
from toolkit.splatting.rendering.cuda.tuning import Tuning

DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
FLOAT32 = Tuning(precision="tf32x3")

if DEVICE == "cpu" and not interpreted():
    pytest.skip("no GPU, and triton was imported to compile", allow_module_level=True)


@dataclass
class OnDevice:
    """A view rendered on the GPU and copied to the CPU for comparison."""

    drawn: ForwardPass

    @property
    def images(self) -> Tensor:
        return self.drawn.images.cpu()

    def backward(self, image_gradients: Tensor, **options: bool) -> GaussianGradients:
        found = self.drawn.backward(image_gradients.to(DEVICE), **options)
        return found.to(torch.device("cpu"))


class Cuda:
    """The backend with transfers from and to the CPU."""

    name = "cuda"

    def __init__(self, tuning: Tuning = FLOAT32) -> None:
        self._backend = CudaRenderer(tuning)

    def forward(self, gaussians, camera, T_camera_map, features, region, centres=False):
        features = None if features is None else features.to(DEVICE)
        return OnDevice(
            self._backend.forward(
                gaussians.to(DEVICE), camera, T_camera_map, features, region, centres
            )
        )


def assert_agrees(scene: Scene, tuning: Tuning = FLOAT32, tolerance: float = 2e-4) -> None:
    """Assert that images and gradients of a random loss equal the float64 reference."""
    drawn = scene.forward(Cuda(tuning))
    assert_same_images(drawn.images, scene, reference_images(scene))
    weights = scene.loss_weights()
    expected = gradients_of(exact(scene), ReferenceBackend(), weights)
    assert_same_gradients(gradients_of(scene, Cuda(tuning), weights), expected, tolerance)
