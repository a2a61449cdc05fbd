"""What is done many times a frame on a GPU neither asks the host nor takes images from it.

Tensors on torch's "meta" device have no values: to read one raises, as does most arithmetic
with a tensor of the CPU. So what runs here runs on a GPU without waiting.
"""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from toolkit.base.exposure import Exposure
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe, Observed
from toolkit.semantics.codes import binary_code, flat_code, one_hot_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.sparse_adam import LearningRates, SparseAdam
from toolkit.slam.submaps.optimiser_state import OptimiserState
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import model_level, pyramid, view_level
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.options import RgbdLossWeights
from toolkit.splatting.losses.photometric import rgbd_loss_torch
from toolkit.splatting.rendering.surface import SurfaceView, surface_depth
from toolkit.splatting.rendering.texture import resample_at_centres

META = torch.device("meta")
CAMERA = Camera(50.0, 52.0, 23.5, 17.5, 48, 36)
POINTS = np.zeros((0, 3), np.float32)
MOST_BROUGHT = 64  # numbers: a pose, intrinsics, a table of a few classes


class NothingLarge(TorchDispatchMode):
    """Refuses operations that bring more than a few numbers from the CPU."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        made = [x for x in tree_leaves(out) if isinstance(x, Tensor)]
        if any(x.device == META for x in made):
            for x in tree_leaves((args, kwargs)):
                if isinstance(x, Tensor) and x.device != META:
                    assert x.numel() <= MOST_BROUGHT, f"{function} brings {list(x.shape)}"
        return out


@pytest.fixture(autouse=True)
def nothing_large() -> Iterator[None]:
    with NothingLarge():
        yield


def image(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.empty(*shape, CAMERA.height, CAMERA.width, dtype=dtype, device=META)


def test_the_surface_of_a_view() -> None:
    depth_m = surface_depth(image(8), CAMERA, np.eye(4), 0.5)
    assert depth_m.device == META and depth_m.shape == (36, 48)


def test_pyramids_and_what_alignment_compares() -> None:
    levels = pyramid(FrameLevel(CAMERA, image(), image()), 3)
    assert [level.depth_m.shape for level in levels] == [(36, 48), (18, 24), (9, 12)]
    for model in (model_level(level) for level in levels):
        assert model.texture.device == model.surface.device == META


def test_the_mapping_loss_and_its_derivative() -> None:
    images = image(5).requires_grad_()
    value = rgbd_loss_torch(images, image(), (image(3), image()), RgbdLossWeights())
    (gradient,) = torch.autograd.grad(value, images)
    assert gradient.shape == (5, 36, 48)


def test_where_the_colours_of_a_view_belong() -> None:
    view = SurfaceView(SimpleNamespace(images=image(8)), image(), CAMERA, np.eye(4), True)
    assert resample_at_centres(image(3), view).shape == (3, 36, 48)
    assert view_level(view, 0.9).intensity.device == META


@pytest.mark.parametrize("code", [flat_code, one_hot_code, binary_code])
def test_the_semantic_loss_of_some_pixels(code) -> None:
    made = code(Taxonomy({"thing": {"a": ["x", "y", "u"], "b": ["z", "v"]}, "plant": ["w"]}))
    values = torch.empty(made.channels, 500, device=META)
    ids = torch.empty(500, dtype=torch.int32, device=META)
    assert made.pixel_loss(values, ids).shape == (500,)


def test_what_a_keyframe_observed() -> None:
    images = Observed(image(3, dtype=torch.uint8), image(), image(dtype=torch.int16))
    keyframe = Keyframe(
        0, 0.0, np.eye(4), torch.empty(0), torch.empty(0), CAMERA, Exposure(1.1, 0.02), POINTS
    )
    rgb, depth_m, labels = keyframe.observed(images)
    assert labels is not None
    assert rgb.device == depth_m.device == labels.device == META


def test_a_step_of_the_map() -> None:
    state = OptimiserState(torch.zeros(100, dtype=torch.int32, device=META))
    widths = {
        "means": (3,),
        "log_radii": (),
        "opacity_logits": (),
        "colours": (3,),
        "features": (4,),
    }
    cloud = GaussianCloud(**{n: torch.empty(100, *w, device=META) for n, w in widths.items()})
    seen = {n: torch.empty(70, *w, device=META) for n, w in widths.items()}
    SparseAdam(LearningRates()).step(
        state, cloud, seen, torch.empty(70, dtype=torch.int64, device=META)
    )
    assert state.steps.device == META
