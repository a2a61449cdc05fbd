"""render(): shapes, errors, selection of the backend, memory."""

from __future__ import annotations

import gc
import sys
import weakref
from collections.abc import Iterator

import numpy as np
import pytest
import torch
from splat_scenes import random_scene, scene_at_pixels, skewed_camera

from toolkit.base import native
from toolkit.base.errors import DependencyError, SettingsError
from toolkit.base.native import loading
from toolkit.splatting.rendering import backend, render

needs_kernels = pytest.mark.skipif(
    not native.available_instruction_sets(), reason="no native kernels were built"
)


@pytest.fixture(autouse=True)
def forgotten_choices() -> Iterator[None]:
    """Clears the cached choice of backend and kernels before and after each test."""
    loading.kernels.cache_clear()
    backend.cache_clear()
    yield
    loading.kernels.cache_clear()
    backend.cache_clear()


def test_shapes_of_the_output() -> None:
    scene = random_scene(0, channels=7, size=(33, 20))
    output = render(scene.cloud, scene.camera, scene.T_camera_map, features=scene.cloud.features)
    assert output.images.shape == (12, 20, 33)
    assert output.colour.shape == (20, 33, 3)
    assert output.depth_m.shape == output.depth_sum_m.shape == output.silhouette.shape == (20, 33)
    assert output.features.shape == (20, 33, 7)
    without = render(scene.cloud, scene.camera, scene.T_camera_map)
    assert without.features.shape == (20, 33, 0)
    assert torch.equal(without.images, output.images[:5])


@pytest.mark.parametrize("name", ["auto", "reference"])
def test_gradients_only_for_tensors_that_require_them(name: str) -> None:
    scene = random_scene(1)
    T = torch.from_numpy(scene.T_camera_map).requires_grad_()
    pose_only = render(scene.cloud, scene.camera, T, backend_name=name)
    pose_only.images.sum().backward()
    assert T.grad is not None and T.grad.dtype == torch.float64
    expected = T.grad.clone()
    T.grad = None
    cloud = scene.cloud.detached()
    cloud.means.requires_grad_()
    render(cloud, scene.camera, T, backend_name=name).images.sum().backward()
    assert cloud.means.grad is not None
    assert T.grad is not None and torch.equal(T.grad, expected)
    assert cloud.colours.grad is None


def test_no_gradient_without_leaves() -> None:
    scene = random_scene(1)
    assert not render(scene.cloud, scene.camera, scene.T_camera_map).images.requires_grad


def test_other_dtypes_and_strides_are_accepted() -> None:
    scene = random_scene(2)
    expected = render(scene.cloud, scene.camera, scene.T_camera_map).images
    wide = scene.with_cloud(
        means=scene.cloud.means.double(),
        colours=scene.cloud.colours.repeat(1, 2)[:, :3],
        log_radii=torch.stack([scene.cloud.log_radii] * 2, dim=1)[:, 0],
    )
    assert torch.equal(render(wide.cloud, wide.camera, wide.T_camera_map).images, expected)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"T_camera_map": np.eye(4)[:3]}, r"T_camera_map must have shape \[4, 4\], got \[3, 4\]"),
        ({"features": torch.zeros(9, 2)}, r"features must have shape \[60, S\], got \[9, 2\]"),
        ({"features": torch.zeros(60)}, r"features must have shape \[60, S\], got \[60\]"),
        (
            {"region": torch.ones(3, 2, dtype=torch.bool)},
            r"region must have shape \[3, 3\], got \[3, 2\]",
        ),
    ],
)
def test_arguments_of_wrong_shape_raise(change: dict, message: str) -> None:
    scene = random_scene(0)
    arguments = {"T_camera_map": scene.T_camera_map} | change
    with pytest.raises(ValueError, match=message):
        render(scene.cloud, scene.camera, **arguments)


@needs_kernels
def test_image_gradients_of_wrong_shape_raise() -> None:
    scene = random_scene(0, channels=2)
    drawn = scene.forward(backend("native"))
    with pytest.raises(ValueError, match=r"image gradients must have shape \[7, 37, 45\]"):
        drawn.backward(torch.zeros(6, 37, 45))
    # Five channels without the features.
    with pytest.raises(ValueError, match=r"image gradients must have shape \[5, 37, 45\]"):
        drawn.backward(torch.zeros(5, 37, 44))


def test_second_derivatives_raise() -> None:
    scene = random_scene(1, count=10, size=(12, 9))
    cloud = scene.cloud.detached()
    cloud.means.requires_grad_()
    images = render(cloud, scene.camera, scene.T_camera_map).images
    (gradient,) = torch.autograd.grad((images**2).sum(), cloud.means, create_graph=True)
    with pytest.raises(RuntimeError, match="once_differentiable"):
        gradient.sum().backward()


def test_unknown_and_unavailable_backends_raise() -> None:
    with pytest.raises(SettingsError, match="unknown rendering backend 'gpu'"):
        backend("gpu")


def test_errors_of_gpu_backends_name_the_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setitem(sys.modules, "triton", None)
    for name in [n for n in sys.modules if n.startswith("toolkit.splatting.rendering.cuda")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(DependencyError, match="cuda backend needs triton"):
        backend("cuda")
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(DependencyError, match="pip install gsplat"):
        backend("gsplat")


def test_compiled_kernels_need_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    module = pytest.importorskip("toolkit.splatting.rendering.cuda.backend")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(module, "interpreted", lambda: False)
    with pytest.raises(DependencyError, match="needs a CUDA device"):
        backend("cuda")


@needs_kernels
def test_native_is_the_default_if_built() -> None:
    assert backend("auto").name == "native"


def test_reference_is_the_default_without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(native.ISA_VARIABLE, raising=False)
    monkeypatch.setattr(loading, "available_instruction_sets", list)
    assert native.kernels() is None
    assert backend("auto").name == "reference"
    with pytest.raises(DependencyError, match="native kernels are not built"):
        backend("native")
    scene = scene_at_pixels([(4, 3)], skewed_camera(9, 7))
    output = render(scene.cloud, scene.camera, scene.T_camera_map)
    assert float(output.silhouette[3, 4]) == pytest.approx(0.6, rel=1e-5)


@pytest.mark.parametrize("name", ["auto", "reference"])
def test_deleting_a_rendering_frees_its_memory(name: str) -> None:
    scene = random_scene(1)
    cloud = scene.cloud.detached()
    cloud.means.requires_grad_()
    gc.disable()
    try:
        output = render(cloud, scene.camera, scene.T_camera_map, backend_name=name)
        forward_pass = weakref.ref(getattr(output.images.grad_fn, "forward_pass"))  # noqa: B009
        assert forward_pass() is not None
        del output
        assert forward_pass() is None
    finally:
        gc.enable()
