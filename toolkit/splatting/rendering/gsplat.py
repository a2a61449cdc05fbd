"""Rendering backend that calls gsplat; needs a CUDA device.

gsplat projects the covariance of each Gaussian, while our projections are always circular, so
results differ slightly away from the optical axis. gsplat's pixel centres are at half-integers,
ours at integers.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.errors import DependencyError
from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import BASE_CHANNELS, NEAR_M
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.backend import ForwardPass, pixels_of_region
from toolkit.splatting.rendering.device_transfer import TransferredForwardPass
from toolkit.splatting.rendering.reference import forward_by_autograd, seen_colours

_FAR_M = 1e10


def load_gsplat() -> Any:
    """Import gsplat.

    Raises:
        DependencyError: gsplat is not installed, or there is no CUDA device.
    """
    try:
        module = importlib.import_module("gsplat")
    except ImportError as error:
        raise DependencyError(
            "the gsplat backend needs gsplat: pip install gsplat, or use --backend cuda"
        ) from error
    if not torch.cuda.is_available():
        raise DependencyError(
            "gsplat needs a CUDA device, but none is available; use --backend native"
        )
    return module


class GsplatBackend:
    """gsplat's rasterization on the GPU that stores the Gaussians, with autograd gradients.

    Args:
        package: the gsplat module; imported by default.
        device: device that renders Gaussians stored on the CPU.
    """

    name = "gsplat"

    def __init__(self, package: Any = None, device: str = "cuda") -> None:
        self._package = package or load_gsplat()
        self._device = torch.device(device)

    def forward(
        self,
        gaussians: GaussianCloud,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        features: Tensor | None,
        region: Tensor | None,
        centres: bool = False,
    ) -> ForwardPass:
        """See Backend.forward. The region is applied as a mask after rendering."""
        home = gaussians.means.device
        device = home if home.type == "cuda" else self._device

        def render_images(cloud: GaussianCloud, T: Tensor, extra: Tensor) -> Tensor:
            images = self._images(cloud, camera, T, extra)
            if region is None:
                return images
            return images * pixels_of_region(region.to(images.device), *images.shape[1:])

        features = None if features is None else features.to(device)
        forward_pass = forward_by_autograd(
            render_images, gaussians.to(device), T_camera_map, features, centres
        )
        return forward_pass if device == home else TransferredForwardPass(forward_pass, home)

    def _images(
        self, cloud: GaussianCloud, camera: Camera, T_camera_map: Tensor, extra: Tensor
    ) -> Tensor:
        """Render images [5 + S, H, W] of colours and additional channels [N, S]."""
        if len(cloud) == 0:
            return cloud.means.new_zeros(
                BASE_CHANNELS + extra.shape[1], camera.height, camera.width
            )
        shapes, low_pass = cloud.as_ellipsoids(), cloud.low_pass
        last = T_camera_map.new_tensor([[0.0, 0.0, 0.0, 1.0]])
        K = torch.from_numpy(camera.matrix).to(cloud.means)
        K[:2, 2] += 0.5
        rendered, alphas, _ = self._package.rasterization(
            means=cloud.means,
            quats=shapes.rotations,
            scales=shapes.log_scales.exp(),
            opacities=cloud.opacities,
            colors=torch.cat([seen_colours(cloud, T_camera_map), extra], dim=1),
            viewmats=torch.cat([T_camera_map, last])[None],
            Ks=K[None],
            width=camera.width,
            height=camera.height,
            near_plane=NEAR_M,
            far_plane=_FAR_M,
            eps2d=low_pass.variance_px2,
            rasterize_mode="antialiased" if low_pass.compensated else "classic",
            render_mode="RGB+D",
        )
        planes = rendered[0].permute(2, 0, 1)  # colours, additional channels, depth sum
        return torch.cat([planes[:3], planes[-1:], alphas[0].permute(2, 0, 1), planes[3:-1]])
