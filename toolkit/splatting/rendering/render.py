"""`render`: differentiable rendering with any backend."""

from __future__ import annotations

import functools
import logging
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from toolkit.base.errors import DependencyError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.base.native import kernels
from toolkit.splatting.gaussians.cloud import GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering.backend import Backend, ForwardPass, tile_counts
from toolkit.splatting.rendering.gsplat import GsplatBackend
from toolkit.splatting.rendering.native import NativeRenderer
from toolkit.splatting.rendering.output import RenderOutput
from toolkit.splatting.rendering.reference import ReferenceBackend

_log = logging.getLogger(__name__)

BACKENDS = ("auto", "native", "reference", "cuda", "gsplat")


@functools.cache
def backend(name: str = "auto") -> Backend:
    """Return the backend with the given name.

    "auto" renders on the device of the Gaussians: with the cuda backend on a GPU; on the CPU with
    the native backend if it was built, otherwise with plain torch.

    Raises:
        SettingsError: the name is unknown.
        DependencyError: the backend is not available on this machine.
    """
    if name == "auto":
        on_cpu = backend("native" if kernels() is not None else "reference")
        return _DeviceDispatch(on_cpu) if torch.cuda.is_available() else on_cpu
    if name == "native":
        return NativeRenderer()
    if name == "reference":
        return ReferenceBackend()
    if name == "cuda":
        return _cuda_backend()
    if name == "gsplat":
        return GsplatBackend()
    raise SettingsError(f"unknown rendering backend '{name}'; choose one of {', '.join(BACKENDS)}")


def _cuda_backend() -> Backend:
    try:
        from toolkit.splatting.rendering.cuda.backend import CudaRenderer, interpreted
    except ImportError as error:
        raise DependencyError(
            f"the cuda backend needs triton, which comes with torch's CUDA build ({error}): "
            "pip install 'semsplat[cuda]', or use --backend native"
        ) from error
    if not (torch.cuda.is_available() or interpreted()):
        raise DependencyError(
            "the cuda backend needs a CUDA device, but none is available; use --backend native"
        )
    return CudaRenderer()


class _DeviceDispatch:
    """Renders each map on the device that stores it."""

    name = "auto"

    def __init__(self, on_cpu: Backend) -> None:
        self._on_cpu = on_cpu

    def forward(
        self,
        gaussians: GaussianCloud,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        features: Tensor | None,
        region: Tensor | None,
        centres: bool = False,
    ) -> ForwardPass:
        """See Backend.forward."""
        chosen = backend("cuda") if gaussians.means.is_cuda else self._on_cpu
        return chosen.forward(gaussians, camera, T_camera_map, features, region, centres)


def map_device(name: str, backend_name: str) -> str:
    """Return the device on which a map is stored and optimised, "cpu" or "cuda".

    Args:
        name: "cpu", "cuda", or "auto" (the GPU if there is one and the backend supports it).
        backend_name: rendering backend of the map.

    Raises:
        SettingsError: the backend does not support the device.
        DependencyError: there is no CUDA device, or no backend for it.
    """
    on_cpu = backend_name in ("native", "reference")
    if name == "cpu" or (name == "auto" and (on_cpu or not torch.cuda.is_available())):
        return "cpu"
    if on_cpu:
        raise SettingsError(
            f"--device cuda cannot be used with --backend {backend_name}, which renders on the "
            "CPU; use --backend auto"
        )
    if not torch.cuda.is_available():
        raise DependencyError(
            "--device cuda needs a CUDA device, but none is available; use --device auto"
        )
    try:
        backend("cuda" if backend_name == "auto" else backend_name)
    except DependencyError as error:
        if name == "cuda":
            raise
        _log.warning("The GPU is not used: %s", error)
        return "cpu"
    return "cuda"


def render(
    gaussians: GaussianCloud,
    camera: Camera,
    T_camera_map: Tensor | NDArray[np.float64],
    *,
    features: Tensor | None = None,
    region: Tensor | None = None,
    backend_name: str = "auto",
) -> RenderOutput:
    """Render Gaussians from a camera pose (H-19, H-20, G-1).

    Differentiable with respect to all Gaussian parameters, the features and the pose.

    Args:
        gaussians: N Gaussians in the map's frame.
        camera: intrinsics and image size H, W.
        T_camera_map: [4, 4], map to camera; a tensor may require gradients.
        features: [N, S] additional channels to composite, or None.
        region: [ceil(H / 16), ceil(W / 16)] bool, tiles to render; other tiles are 0.
        backend_name: "auto", "native", "reference", "cuda" or "gsplat".

    Returns:
        Colour, depth, silhouette and features, [H, W, ...].

    Raises:
        ValueError: an argument has the wrong shape.
    """
    _check(gaussians, camera, T_camera_map, features, region)
    chosen = backend(backend_name)
    if features is None:
        features = gaussians.means.new_zeros(len(gaussians), 0)
    shapes = gaussians.ellipsoids
    images = _Render.apply(
        chosen,
        camera,
        region,
        gaussians.low_pass,
        torch.as_tensor(T_camera_map),
        gaussians.means,
        gaussians.log_radii,
        gaussians.opacity_logits,
        gaussians.colours,
        features,
        *(shapes.tensors().values() if shapes else ()),
    )
    return RenderOutput(images)


def _check(
    gaussians: GaussianCloud,
    camera: Camera,
    T_camera_map: Tensor | NDArray[np.float64],
    features: Tensor | None,
    region: Tensor | None,
) -> None:
    if tuple(T_camera_map.shape) != (4, 4):
        raise ValueError(f"T_camera_map must have shape [4, 4], got {list(T_camera_map.shape)}")
    if features is not None and (features.ndim != 2 or len(features) != len(gaussians)):
        raise ValueError(
            f"features must have shape [{len(gaussians)}, S], got {list(features.shape)}"
        )
    if region is not None and tuple(region.shape) != tile_counts(camera):
        raise ValueError(
            f"region must have shape {list(tile_counts(camera))}, got {list(region.shape)}"
        )


class _Render(torch.autograd.Function):
    """Autograd function of a backend; expands the gradients of visible Gaussians to all."""

    @staticmethod
    def forward(  # noqa: PLR0913 - autograd needs every tensor as a separate argument
        ctx: Any,
        chosen: Backend,
        camera: Camera,
        region: Tensor | None,
        low_pass: LowPass,
        T_camera_map: Tensor,
        means: Tensor,
        log_radii: Tensor,
        opacity_logits: Tensor,
        colours: Tensor,
        features: Tensor,
        *shapes: Tensor,
    ) -> Tensor:
        ellipsoids = Ellipsoids(*shapes) if shapes else None
        cloud = GaussianCloud(
            *(means, log_radii, opacity_logits, colours, features),
            ellipsoids=ellipsoids,
            low_pass=low_pass,
        )
        pose = T_camera_map.detach().to(torch.float64).cpu().numpy()
        ctx.forward_pass = chosen.forward(cloud, camera, pose, features, region)
        ctx.pose_type = T_camera_map
        ctx.parameters = (means, log_radii, opacity_logits, colours, features, *shapes)
        # Detached, because the returned tensor references ctx: a reference cycle would keep the
        # view in memory.
        return ctx.forward_pass.images.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image_gradients: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad
        compact = ctx.forward_pass.backward(image_gradients, colours=needed[8])
        shapes = compact.ellipsoids
        parts = (
            compact.means,
            compact.log_radii,
            compact.opacity_logits,
            compact.colours,
            compact.features,
            *(shapes.tensors().values() if shapes else ()),
        )
        dense: list[Tensor | None] = []
        for parameter, part, need in zip(ctx.parameters, parts, needed[5:], strict=True):
            if not need or part is None:
                dense.append(None)
                continue
            gradient = torch.zeros_like(parameter)
            gradient[compact.ids] = part.to(gradient)
            dense.append(gradient)
        pose = None
        if needed[4]:
            pose = torch.zeros_like(ctx.pose_type)
            pose[:3] = compact.T_camera_map.to(pose)
        return (None, None, None, None, pose, *dense)
