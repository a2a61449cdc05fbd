"""The compiled CPU renderer: which variant runs here, and its calls."""

from __future__ import annotations

import functools
import importlib
import os
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.errors import DependencyError
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.rendering.backend import GaussianGradients
from toolkit.rendering.output import BASE_CHANNELS

INSTRUCTION_SETS = ("base", "avx2", "avx512")
ISA_VARIABLE = "SEMSPLAT_ISA"


def _load(instruction_set: str) -> ModuleType | None:
    try:
        return importlib.import_module(f"toolkit.rendering._native_{instruction_set}")
    except ImportError:
        return None


def available_instruction_sets() -> list[str]:
    """The variants that were built and that this processor can run, weakest first."""
    base = _load("base")
    if base is None:
        return []
    best = INSTRUCTION_SETS.index(base.instruction_set())
    return [name for name in INSTRUCTION_SETS[: best + 1] if _load(name) is not None]


@functools.cache
def kernels() -> ModuleType | None:
    """The best compiled variant for this processor, or None where none was built.

    SEMSPLAT_ISA = base, avx2 or avx512 forces one.

    Raises:
        DependencyError: the forced variant is unknown or cannot run here.
    """
    names = available_instruction_sets()
    forced = os.environ.get(ISA_VARIABLE)
    if not forced:
        return _load(names[-1]) if names else None
    if forced not in names:
        raise DependencyError(
            f"{ISA_VARIABLE}={forced} cannot run here; available: {', '.join(names) or 'none'}"
        )
    return _load(forced)


def kernels_for(tensor: Tensor) -> ModuleType | None:
    """The compiled kernels where they can work on a tensor: it must lie on the CPU."""
    return kernels() if tensor.device.type == "cpu" else None


def require_kernels() -> ModuleType:
    """The compiled kernels.

    Raises:
        DependencyError: none were built.
    """
    module = kernels()
    if module is None:
        raise DependencyError(
            "the native kernels are not built; install a C++ compiler (apt-get install g++) "
            "and run: pip install --force-reinstall --no-deps ."
        )
    return module


def address(tensor: Tensor | None) -> int:
    """Address of a contiguous tensor's data, 0 for None."""
    return 0 if tensor is None else tensor.data_ptr()


def _contiguous(tensor: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    return tensor.detach().to(device="cpu", dtype=dtype).contiguous()


class NativeForwardPass:
    """A view drawn by the native kernels, with what its backward pass needs."""

    def __init__(
        self, module: ModuleType, idle: list[Any], arrays: list[Tensor], region: Tensor | None
    ):
        self._module, self._arrays, self._region = module, arrays, region
        self._idle = idle
        self._channels = BASE_CHANNELS + arrays[4].shape[1]
        self._state = idle.pop() if idle else module.Rasterisation()
        self.images = torch.empty(0)

    def __del__(self) -> None:
        # Its buffers serve the next view: fresh pages would cost as much as the drawing.
        self._idle.append(self._state)

    @property
    def _map(self) -> tuple[int, list[int], int]:
        return len(self._arrays[0]), [address(a) for a in self._arrays], self._arrays[4].shape[1]

    def draw(self, camera: Camera, T_camera_map: NDArray[np.float64], centres: bool) -> None:
        """Fill `images`."""
        # Tiles outside a region are never written, so they must start at zero.
        create = torch.empty if self._region is None else torch.zeros
        channels = self._channels + (3 if centres else 0)
        self.images = create(channels, camera.height, camera.width)
        self._module.forward(
            self._state,
            *self._map,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            camera.size,
            np.asarray(T_camera_map, dtype=np.float64)[:3].reshape(-1).tolist(),
            address(self._region),
            centres,
            address(self.images),
        )

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """See ForwardPass.backward."""
        n = self._state.visible
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
        result = GaussianGradients(
            ids=torch.empty(n, dtype=torch.int64),
            means=torch.empty(n, 3),
            log_radii=torch.empty(n),
            opacity_logits=torch.empty(n),
            colours=torch.empty(n, 3) if colours else None,
            features=torch.empty(n, self._arrays[4].shape[1]),
            T_camera_map=torch.empty(3, 4, dtype=torch.float64),
        )
        self._module.copy_visible(self._state, address(result.ids))
        sinks = (
            result.means,
            result.log_radii,
            result.opacity_logits,
            result.colours,
            result.features,
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


class NativeBackend:
    """C++ kernels on the CPU: tiles of 16x16 pixels, one 4x4 block a vector."""

    name = "native"

    def __init__(self) -> None:
        self._module = require_kernels()
        self._idle: list[Any] = []  # states of views that are done with

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
        region = None if region is None else _contiguous(region, torch.uint8)
        drawn = NativeForwardPass(self._module, self._idle, arrays, region)
        drawn.draw(camera, T_camera_map, centres)
        return drawn
