"""`render`: one call, one output type, every backend."""

from __future__ import annotations

import functools
import logging
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd.function import once_differentiable

from toolkit.errors import DependencyError, SettingsError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.native import kernels
from toolkit.rendering.backend import Backend, ForwardPass, tile_counts
from toolkit.rendering.gsplat import GsplatBackend
from toolkit.rendering.native import NativeBackend
from toolkit.rendering.output import RenderOutput
from toolkit.rendering.reference import ReferenceBackend

_log = logging.getLogger(__name__)

BACKENDS = ("auto", "native", "reference", "cuda", "gsplat")


@functools.cache
def backend(name: str = "auto") -> Backend:
    """The backend of a name.

    "auto" draws where the Gaussians are: on a GPU with the cuda backend, on the CPU with the
    native one where it was built, else in plain torch.

    Raises:
        SettingsError: unknown name.
        DependencyError: the backend cannot run here.
    """
    if name == "auto":
        on_cpu = backend("native" if kernels() is not None else "reference")
        return _ByDevice(on_cpu) if torch.cuda.is_available() else on_cpu
    if name == "native":
        return NativeBackend()
    if name == "reference":
        return ReferenceBackend()
    if name == "cuda":
        return _cuda_backend()
    if name == "gsplat":
        return GsplatBackend()
    raise SettingsError(f"unknown rendering backend '{name}'; choose one of {', '.join(BACKENDS)}")


def _cuda_backend() -> Backend:
    try:
        from toolkit.rendering.cuda.backend import CudaBackend, interpreted
    except ImportError as error:
        raise DependencyError(
            f"the cuda backend needs triton, which comes with torch's CUDA build ({error}): "
            "pip install 'semsplat[cuda]', or use --backend native"
        ) from error
    if not (torch.cuda.is_available() or interpreted()):
        raise DependencyError(
            "the cuda backend needs a CUDA device, and none is there; use --backend native"
        )
    return CudaBackend()


class _ByDevice:
    """Each map is drawn where it lies."""

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
    """Where a map is kept and optimised, "cpu" or "cuda".

    Args:
        name: "cpu", "cuda", or "auto": a GPU where there is one and the backend draws there.
        backend_name: that draws it.

    Raises:
        SettingsError: the backend cannot draw there.
        DependencyError: there is no GPU, or no backend for it.
    """
    on_cpu = backend_name in ("native", "reference")
    if name == "cpu" or (name == "auto" and (on_cpu or not torch.cuda.is_available())):
        return "cpu"
    if on_cpu:
        raise SettingsError(
            f"--device cuda and --backend {backend_name}, which draws on the CPU; "
            "use --backend auto"
        )
    if not torch.cuda.is_available():
        raise DependencyError("--device cuda, and no CUDA device is there; use --device auto")
    try:
        backend("cuda" if backend_name == "auto" else backend_name)
    except DependencyError as error:
        if name == "cuda":
            raise
        _log.warning("the GPU stays idle: %s", error)
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
    """Draw Gaussians as a camera sees them (H-19, H-20, G-1).

    Differentiable in every Gaussian parameter, the features and the pose.

    Args:
        gaussians: N Gaussians in the map's frame.
        camera: intrinsics and image size H, W.
        T_camera_map: [4, 4], map to camera; a tensor may require gradients.
        features: [N, S] channels to composite beside the colour, or None for none.
        region: [ceil(H / 16), ceil(W / 16)] bool; only these tiles are drawn, others stay 0.
        backend_name: "auto", "native", "reference", "cuda" or "gsplat".

    Returns:
        Colour, depth, silhouette and features, [H, W, ...].

    Raises:
        ValueError: a shape is wrong.
    """
    _check(gaussians, camera, T_camera_map, features, region)
    chosen = backend(backend_name)
    if features is None:
        features = gaussians.means.new_zeros(len(gaussians), 0)
    images = _Render.apply(
        chosen,
        camera,
        region,
        torch.as_tensor(T_camera_map),
        gaussians.means,
        gaussians.log_radii,
        gaussians.opacity_logits,
        gaussians.colours,
        features,
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
    """Hands a backend's two passes to autograd, compact gradients made dense."""

    @staticmethod
    def forward(  # noqa: PLR0913 - autograd wants every tensor as an argument of its own
        ctx: Any,
        chosen: Backend,
        camera: Camera,
        region: Tensor | None,
        T_camera_map: Tensor,
        means: Tensor,
        log_radii: Tensor,
        opacity_logits: Tensor,
        colours: Tensor,
        features: Tensor,
    ) -> Tensor:
        cloud = GaussianCloud(means, log_radii, opacity_logits, colours, features)
        pose = T_camera_map.detach().to(torch.float64).cpu().numpy()
        ctx.drawn = chosen.forward(cloud, camera, pose, features, region)
        ctx.pose_type = T_camera_map
        ctx.parameters = (means, log_radii, opacity_logits, colours, features)
        # Detached: the returned tensor knows ctx, and a cycle would outlive every view.
        return ctx.drawn.images.detach()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, image_gradients: Tensor) -> tuple[Tensor | None, ...]:
        needed = ctx.needs_input_grad
        compact = ctx.drawn.backward(image_gradients, colours=needed[7])
        parts = (
            compact.means,
            compact.log_radii,
            compact.opacity_logits,
            compact.colours,
            compact.features,
        )
        dense: list[Tensor | None] = []
        for parameter, part, need in zip(ctx.parameters, parts, needed[4:], strict=True):
            if not need or part is None:
                dense.append(None)
                continue
            gradient = torch.zeros_like(parameter)
            gradient[compact.ids] = part.to(gradient)
            dense.append(gradient)
        pose = None
        if needed[3]:
            pose = torch.zeros_like(ctx.pose_type)
            pose[:3] = compact.T_camera_map.to(pose)
        return (None, None, None, pose, *dense)
