"""Mapping and tracking on a pretended GPU: nothing forgets where its inputs are."""

from __future__ import annotations

import importlib
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from pretended_gpu import pretended_gpu

from toolkit.datasets.synthetic import tiny_room
from toolkit.errors import DependencyError, SettingsError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.losses.photometric import rgbd_loss
from toolkit.mapping import mapper as mapper_module
from toolkit.mapping.mapper import Mapper, MapperOptions
from toolkit.rendering import GaussianGradients, SurfaceView, backend, map_device
from toolkit.rendering.backend import ForwardPass
from toolkit.tracking import dense, first_order
from toolkit.tracking.alignment import FrameLevel, ModelLevel, linearise
from toolkit.tracking.dense import DenseOptions, DenseTracker
from toolkit.tracking.first_order import FirstOrderOptions, FirstOrderTracker

SIZE = (48, 36)
GPU = "cuda:0"
KINDS = ("dense", "first-order")


@pytest.fixture(scope="module")
def walk():
    """Frames, and their true poses in the first camera's frame."""
    frames, truth = tiny_room(2, *SIZE)
    return frames, se3.inverse(truth.T_world_camera[0]) @ truth.T_world_camera


class FarBackend:
    """What draws on a GPU, with the CPU's backend behind it."""

    name = "far"

    def forward(self, gaussians, camera, T_camera_map, features, region, centres=False):
        assert gaussians.means.is_cuda and (region is None or region.is_cuda)
        here = [None if t is None else t.cpu() for t in (features, region)]
        return FarPass(
            backend().forward(gaussians.to("cpu"), camera, T_camera_map, *here, centres=centres)
        )


class FarPass:
    """One view of it."""

    def __init__(self, drawn: ForwardPass) -> None:
        self._drawn, self.images = drawn, drawn.images.to(GPU)

    def backward(self, image_gradients, colours=True, detached=False):
        assert image_gradients.is_cuda
        found = self._drawn.backward(image_gradients.cpu(), colours, detached)
        parts = {f.name: getattr(found, f.name) for f in fields(found)}
        return GaussianGradients(
            **{name: None if t is None else t.to(GPU) for name, t in parts.items()}
        )


def far_loss(view, rgb, depth_m, weights, out):
    """The mapping loss, whose autograd wants a true device."""
    assert view.depth_m.is_cuda and rgb.is_cuda and depth_m.is_cuda and out.is_cuda
    near = SurfaceView(SimpleNamespace(images=view.drawn.images.cpu()), view.depth_m.cpu())
    value, gradient = rgbd_loss(near, rgb.cpu(), depth_m.cpu(), weights)
    return value, out.copy_(gradient.to(GPU))


@pytest.fixture
def gpu(monkeypatch):
    """A pretended one, and stand-ins for what only a true one can do."""
    for module in (mapper_module, dense, first_order):
        monkeypatch.setattr(module, "backend", lambda name: FarBackend())
    monkeypatch.setattr(mapper_module, "rgbd_loss", far_loss)
    with pretended_gpu():
        yield


def mapped(device: str, walk) -> Mapper:
    """Two keyframes mapped, refined, written down and read again."""
    options = MapperOptions(
        first_iterations=2,
        iterations=3,
        final_iterations=1,
        tile_share=0.5,
        bundle_adjustment=True,
    )
    mapper, again = (Mapper(options, np.random.default_rng(0), device=device) for _ in range(2))
    for frame, pose in zip(*walk, strict=True):
        mapper.add_keyframe(frame, pose)
    mapper.refine()
    again.restore(*mapper.state())
    again.settle(1)
    again.take(again.content)
    again.settle(1)
    return again


@pytest.fixture(scope="module")
def mapped_here(walk):
    return mapped("cpu", walk).content


def test_mapping(walk, mapped_here, gpu):
    mapper = mapped(GPU, walk)
    for field in fields(GaussianCloud):
        assert getattr(mapper.gaussians, field.name).is_cuda, field.name
    assert mapper.seeded_by.is_cuda and mapper.optimiser.steps.is_cuda
    content = mapper.content
    assert np.array_equal(content.steps.numpy(), mapped_here.steps.numpy())
    for field in fields(GaussianCloud):
        actual, truth = (getattr(c.gaussians, field.name) for c in (content, mapped_here))
        assert np.allclose(actual.numpy(), truth.numpy(), atol=1e-3), field.name


def on_cpu(level):
    """A level of a pyramid, brought back."""
    parts = {f.name: getattr(level, f.name) for f in fields(level)}
    moved = {k: v.cpu() if isinstance(v, torch.Tensor) else v for k, v in parts.items()}
    return replace(level, **moved)


@pytest.fixture
def without_triton(monkeypatch):
    """The steps themselves, which Triton does on a GPU, on the CPU."""

    def align(tracker, task, view, estimate, coarse):
        task = replace(task, levels=[on_cpu(level) for level in task.levels])
        view = replace(view, levels=[on_cpu(level) for level in view.levels])
        tracker._align(task, view, estimate, coarse)

    def sums(model: ModelLevel, frame: FrameLevel, *rest):
        assert model.texture.is_cuda and frame.depth_m.is_cuda
        return linearise(on_cpu(model), on_cpu(frame), *rest)

    monkeypatch.setattr(DenseTracker, "_align_on_gpu", align)
    monkeypatch.setattr(dense, "linearise", sums)
    monkeypatch.setattr(first_order, "linearise", sums)


@pytest.fixture(scope="module")
def one_view(walk):
    """A map of the first frame, and where trackers on the CPU find the second."""
    frames, poses = walk
    mapper = Mapper(MapperOptions(first_iterations=2))
    mapper.add_keyframe(frames[0], poses[0])
    return mapper.gaussians, {kind: tracked(kind, frames, mapper.gaussians) for kind in KINDS}


def tracked(kind: str, frames, gaussians: GaussianCloud):
    """T_map_camera of the second frame."""
    tracker = (
        DenseTracker(DenseOptions(levels=2, iterations=4, start="velocity"))
        if kind == "dense"
        else FirstOrderTracker(FirstOrderOptions(iterations=3))
    )
    tracker.first_pose(frames[0])
    return tracker.track(frames[1], gaussians).T_map_camera


@pytest.mark.parametrize("kind", KINDS)
def test_tracking(walk, one_view, without_triton, gpu, kind):
    gaussians, expected = one_view
    assert np.allclose(tracked(kind, walk[0], gaussians.to(GPU)), expected[kind], atol=1e-4)


def test_where_a_map_is_kept(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert map_device("auto", "auto") == map_device("cpu", "native") == "cpu"
    with pytest.raises(SettingsError, match="--device cuda and --backend native"):
        map_device("cuda", "native")
    with pytest.raises(DependencyError, match="no CUDA device is there"):
        map_device("cuda", "auto")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    # The package names its function like the module.
    module = importlib.import_module("toolkit.rendering.render")
    monkeypatch.setattr(module, "backend", lambda name: None)
    assert map_device("auto", "reference") == "cpu"
    assert map_device("auto", "auto") == map_device("cuda", "gsplat") == "cuda"
