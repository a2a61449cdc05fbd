"""Native rendering backend: calls the C++ rasterisation kernels."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native import address, require_kernels
from toolkit.base.native.constants import BASE_CHANNELS
from toolkit.splatting.gaussians.cloud import GaussianCloud, LowPass
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids
from toolkit.splatting.rendering.backend import GaussianGradients

# Arrays of a map that the kernels receive: five of spheres, three more of ellipsoids.
_ARRAYS = 8


def _contiguous(tensor: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    return tensor.detach().to(device="cpu", dtype=dtype).contiguous()


class NativeForwardPass:
    """A view rendered by the native kernels, with the state for its backward pass."""

    def __init__(
        self, module: ModuleType, idle: list[Any], arrays: list[Tensor], region: Tensor | None
    ):
        self._module, self._arrays, self._region = module, arrays, region
        self._idle = idle
        self._channels = BASE_CHANNELS + arrays[4].shape[1]
        self._harmonics = arrays[7].shape[1] if len(arrays) > 5 else 0
        self._state = idle.pop() if idle else module.Rasterisation()
        self.images = arrays[0].new_empty(0)

    def __del__(self) -> None:
        # Reuse the buffers for the next view: allocating new pages costs as much as rendering.
        self._idle.append(self._state)

    @property
    def _map(self) -> tuple[list[int], list[int]]:
        """Numbers of Gaussians, feature channels and harmonics; addresses of the arrays."""
        addresses = [address(array) for array in self._arrays]
        counts = [len(self._arrays[0]), self._arrays[4].shape[1], self._harmonics]
        return counts, addresses + [0] * (_ARRAYS - len(addresses))

    def render(
        self, camera: Camera, T_camera_map: NDArray[np.float64], low_pass: LowPass, centres: bool
    ) -> None:
        """Render into `images`."""
        # Tiles outside a region are not written and must be initialised with zero.
        means, channels = self._arrays[0], self._channels + (3 if centres else 0)
        create = means.new_empty if self._region is None else means.new_zeros
        self.images = create(channels, camera.height, camera.width)
        self._module.forward(
            self._state,
            *self._map,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            camera.size,
            np.asarray(T_camera_map, dtype=np.float64)[:3].reshape(-1).tolist(),
            (low_pass.variance_px2, low_pass.compensated),
            address(self._region),
            centres,
            address(self.images),
        )

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """See ForwardPass.backward."""
        n, empty = self._state.visible, self._arrays[0].new_empty
        image_gradients = _contiguous(image_gradients)
        without_features = len(image_gradients) == BASE_CHANNELS
        expected = self.images[: BASE_CHANNELS if without_features else self._channels]
        if image_gradients.shape != expected.shape:
            raise ValueError(
                f"image gradients must have shape {list(expected.shape)}, "
                f"got {list(image_gradients.shape)}"
            )
        if without_features:
            self._arrays[4] = self._arrays[4].new_zeros(len(self._arrays[4]), 0)
        shapes = self._empty_ellipsoids(n)
        result = GaussianGradients(
            ids=torch.empty(n, dtype=torch.int64),
            means=empty(n, 3),
            log_radii=empty(n).zero_() if shapes else empty(n),
            opacity_logits=empty(n),
            colours=empty(n, 3) if colours else None,
            features=empty(n, self._arrays[4].shape[1]),
            T_camera_map=torch.empty(3, 4, dtype=torch.float64),
            ellipsoids=shapes,
        )
        self._module.copy_visible(self._state, address(result.ids))
        sinks = (
            result.means,
            result.log_radii,
            result.opacity_logits,
            result.colours,
            result.features,
            *(shapes.tensors().values() if shapes else (None,) * 3),
            result.T_camera_map,
        )
        self._module.backward(
            self._state,
            *self._map,
            address(self._region),
            address(image_gradients),
            detached,
            [address(t) for t in sinks],
        )
        return result

    def _empty_ellipsoids(self, count: int) -> Ellipsoids | None:
        if len(self._arrays) == 5:
            return None
        empty = self._arrays[0].new_empty
        return Ellipsoids(empty(count, 3), empty(count, 4), empty(count, self._harmonics, 3))


class NativeRenderer:
    """C++ kernels on the CPU: tiles of 16x16 pixels, in blocks of one vector each.

    Args:
        module: kernels of one instruction set; by default the best one that the CPU supports.
    """

    name = "native"

    def __init__(self, module: ModuleType | None = None) -> None:
        self._module = require_kernels() if module is None else module
        self._idle: list[Any] = []  # states of released views, for reuse

    def forward(
        self,
        gaussians: GaussianCloud,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        features: Tensor | None,
        region: Tensor | None,
        centres: bool = False,
    ) -> NativeForwardPass:
        """See Backend.forward."""
        arrays = [
            _contiguous(gaussians.means),
            _contiguous(gaussians.log_radii),
            _contiguous(gaussians.opacity_logits),
            _contiguous(gaussians.colours),
            _contiguous(
                features if features is not None else gaussians.means.new_zeros(len(gaussians), 0)
            ),
        ]
        if gaussians.ellipsoids is not None:
            arrays += map(_contiguous, gaussians.ellipsoids.tensors().values())
        region = None if region is None else _contiguous(region, torch.uint8)
        forward_pass = NativeForwardPass(self._module, self._idle, arrays, region)
        forward_pass.render(camera, T_camera_map, gaussians.low_pass, centres)
        return forward_pass
