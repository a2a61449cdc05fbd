"""Mapping and tracking on a GPU give what they give on the CPU; and where a map is kept."""

from __future__ import annotations

import importlib
from typing import Literal

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap
from painted_box import box_frames, path
from torch import Tensor

from toolkit.base.errors import DependencyError, SettingsError
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.first_order_tracker import FirstOrderTracker
from toolkit.slam.tracking.options import FirstOrderOptions
from toolkit.splatting.gaussians.cloud import PARAMETERS, GaussianCloud
from toolkit.splatting.rendering import map_device

SIZE = (96, 72)
GPU = "cuda:0"
KINDS = ("dense", "first-order")

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")


@pytest.fixture(scope="module")
def walk():
    """Frames, and their true poses in the first camera's frame."""
    T_map_camera = path(2)
    return box_frames(T_map_camera, *SIZE), T_map_camera


def mapped(device: str, walk, shape: Literal["spheres", "ellipsoids"]) -> MappedSubmap:
    """Two keyframes mapped, refined, written down and read again."""
    options = MapperOptions(
        first_iterations=2,
        iterations=3,
        final_iterations=1,
        final_shape=shape,
        bundle_adjustment=True,
    )
    mapper, again = (
        MappedSubmap(options, np.random.default_rng(0), device=device) for _ in range(2)
    )
    for frame, pose in zip(*walk, strict=True):
        mapper.add_keyframe(Keyframe.from_frame(frame, pose))
    mapper.refine()
    again.restore(*mapper.state())
    again.optimise_window(1)
    again.submap.optimiser.release()
    again.optimise_window(1)
    return again


def shown(mapper: MappedSubmap) -> tuple[Tensor, Tensor]:
    """Colour [K, 3, H, W] and depth [K, H, W] of the keyframes' views, on the CPU."""
    views = [mapper.view(keyframe) for keyframe in mapper.keyframes]
    colours = torch.stack([view.images[:3].cpu() for view in views])
    return colours, torch.stack([view.depth_m.cpu() for view in views])


@pytest.fixture(scope="module")
def mapped_here(walk):
    return mapped("cpu", walk, "spheres")


@needs_gpu
def test_mapping(walk, mapped_here):
    """The same map but for rounding, which sends a few pixels and Gaussians another way."""
    mapper = mapped(GPU, walk, "spheres")
    for field in PARAMETERS:
        assert getattr(mapper.gaussians, field).is_cuda, field
    assert mapper.submap.seeded_by.is_cuda and mapper.submap.optimiser.steps.is_cuda
    assert len(mapper.gaussians) == pytest.approx(len(mapped_here.gaussians), rel=0.01)
    for actual, expected in zip(shown(mapper), shown(mapped_here), strict=True):
        errors = (actual - expected).abs()
        assert float(errors.mean()) < 1e-3
        assert float((errors > 1e-2).float().mean()) < 0.01


@needs_gpu
def test_ellipsoids(walk):
    """Their optimisation amplifies rounding, but they fit the frames equally well."""
    rgb = torch.from_numpy(np.stack([frame.rgb for frame in walk[0]])).permute(0, 3, 1, 2)
    errors = []
    for device in (GPU, "cpu"):
        mapper = mapped(device, walk, "ellipsoids")
        assert mapper.gaussians.ellipsoids is not None
        for name, tensor in mapper.gaussians.tensors().items():
            assert tensor.device.type == torch.device(device).type, name
        errors.append(float((shown(mapper)[0] - rgb).square().mean().sqrt()))
    assert errors[0] == pytest.approx(errors[1], rel=0.05)


@pytest.fixture(scope="module")
def one_view(walk):
    """A map of the first frame, and where trackers on the CPU find the second."""
    frames, poses = walk
    mapper = MappedSubmap(MapperOptions(first_iterations=10))
    mapper.add_keyframe(Keyframe.from_frame(frames[0], poses[0]))
    return mapper.gaussians, {kind: tracked(kind, frames, mapper.gaussians) for kind in KINDS}


def tracked(kind: str, frames, gaussians: GaussianCloud):
    """T_map_camera of the second frame."""
    tracker = (
        DenseTracker(levels=2)
        if kind == "dense"
        else FirstOrderTracker(FirstOrderOptions(iterations=3))
    )
    tracker.first_pose(frames[0])
    tracker.prepare(frames[1], gaussians.means.device)
    return tracker.track(frames[1], gaussians).T_map_camera


@needs_gpu
@pytest.mark.parametrize("kind", KINDS)
def test_tracking(walk, one_view, kind):
    gaussians, expected = one_view
    found = tracked(kind, walk[0], gaussians.to(GPU))
    assert np.allclose(found, expected[kind], atol=2e-4)


def test_device_of_the_map(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert map_device("auto", "auto") == map_device("cpu", "native") == "cpu"
    with pytest.raises(SettingsError, match="--device cuda cannot be used with --backend native"):
        map_device("cuda", "native")
    with pytest.raises(DependencyError, match="--device cuda needs a CUDA device"):
        map_device("cuda", "auto")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    # The package names its function like the module.
    module = importlib.import_module("toolkit.splatting.rendering.render")
    monkeypatch.setattr(module, "backend", lambda name: None)
    assert map_device("auto", "reference") == "cpu"
    assert map_device("auto", "auto") == map_device("cuda", "gsplat") == "cuda"
