"""What `benchmarks.renderer` compares: the native backend, and a rasteriser from its C++ source."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry.camera import Camera
from toolkit.base.native import load_variant
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.backend import ForwardPass
from toolkit.splatting.rendering.native import NativeRenderer

# Compiler targets of a rival for the instruction sets of ours.
TARGETS = {"base": "x86-64", "avx2": "haswell", "avx512": "native"}
Array = NDArray[np.float32]


@dataclass(frozen=True)
class PixelScene:
    """Gaussians in pixels, as the rival takes them: all [N] float32."""

    width: int
    height: int
    u: Array
    v: Array
    depth_m: Array
    sigma_px: Array
    opacity: Array

    def __len__(self) -> int:
        return len(self.u)

    @property
    def camera(self) -> Camera:
        """A camera with a field of view of about 60 degrees."""
        focal = 0.9 * self.width
        return Camera(focal, focal, self.width / 2, self.height / 2, self.width, self.height)

    def cloud(self, channels: int) -> GaussianCloud:
        """The same Gaussians in metres, with channels - 4 features."""
        camera, z = self.camera, self.depth_m
        x, y = (self.u - camera.cx) / camera.fx * z, (self.v - camera.cy) / camera.fy * z
        generator = torch.Generator().manual_seed(0)
        return GaussianCloud.from_values(
            torch.from_numpy(np.stack([x, y, z], axis=1).astype(np.float32)),
            torch.from_numpy((self.sigma_px * z / camera.focal).astype(np.float32)),
            torch.from_numpy(self.opacity),
            torch.rand(len(self), 3, generator=generator),
            torch.rand(len(self), channels - 4, generator=generator),
        )


def make_scene(width: int, height: int, layers: int, seed: int = 0) -> PixelScene:
    """One jittered Gaussian a pixel and layer."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    shape = (layers, height, width)

    def flat(values: NDArray) -> Array:
        return np.ascontiguousarray(values.reshape(-1), dtype=np.float32)

    return PixelScene(
        width,
        height,
        flat(x + rng.uniform(-0.5, 0.5, shape)),
        flat(y + rng.uniform(-0.5, 0.5, shape)),
        flat(2.0 + 0.5 * np.sin(x / 40.0) + 0.02 * rng.standard_normal(shape)),
        flat(rng.uniform(0.7, 1.5, shape)),
        flat(rng.uniform(0.3, 0.95, shape)),
    )


class Ours:
    """The native backend on one cloud and camera."""

    def __init__(self, cloud: GaussianCloud, camera: Camera, instruction_set: str):
        self._backend = NativeRenderer(load_variant(instruction_set))
        self._cloud, self._camera = cloud, camera
        self._drawn: ForwardPass | None = None
        self._gradients = torch.empty(0)

    def forward(self) -> None:
        """Draw."""
        self._drawn = None  # hands its buffers to this view, as in a running system
        self._drawn = self._backend.forward(
            self._cloud, self._camera, np.eye(4), self._cloud.features, None
        )

    def backward(self) -> None:
        """Gradients of the view drawn last."""
        assert self._drawn is not None
        if self._gradients.shape != self._drawn.images.shape:
            generator = torch.Generator().manual_seed(1)
            self._gradients = torch.randn(self._drawn.images.shape, generator=generator)
        self._drawn.backward(self._gradients)


class Rival:
    """The rough prototype's own path, called as its own benchmark calls it."""

    def __init__(self, library: Path, scene: PixelScene, channels: int):
        self._library, self._scene, self._channels = ctypes.CDLL(str(library)), scene, channels
        n, w, h = len(scene), scene.width, scene.height
        rng = np.random.default_rng(0)
        self._inverse_variance = (1.0 / scene.sigma_px**2).astype(np.float32)
        reach = scene.sigma_px * np.sqrt(2.0 * np.log(255.0 * scene.opacity))
        self._reach = reach.astype(np.float32)
        self._values = rng.random((n, channels), dtype=np.float32)
        tiles = -(-w // 16) * -(-h // 16)
        self._offsets = np.zeros(tiles + 1, np.int32)
        self._last = np.zeros(tiles, np.int32)
        self._pairs = np.zeros(8 * n, np.int32)
        self._image = np.zeros((h, w, channels), np.float32)
        self._transmittance = np.zeros((h, w), np.float32)
        self._d_image = rng.standard_normal((h, w, channels)).astype(np.float32)
        self._d_transmittance = np.zeros((h, w), np.float32)
        self._sinks = [np.zeros(n, np.float32) for _ in range(4)]
        self._sinks.append(np.zeros((n, channels), np.float32))

    def forward(self) -> None:
        """Sort, bin and composite."""
        s = self._scene
        order = np.argsort(s.depth_m, kind="stable").astype(np.int32)
        pairs = self._library.bin(
            len(s),
            *_addresses(s.u, s.v, s.depth_m, self._reach),
            s.width,
            s.height,
            *_addresses(self._offsets, self._pairs),
            len(self._pairs),
            *_addresses(order),
        )
        if pairs < 0:
            raise RuntimeError(f"the rival needs room for {-pairs} pairs")
        self._call(self._library.fwd, self._image, self._transmittance, self._last)

    def backward(self) -> None:
        """Gradients; the sums go on growing, as in its own benchmark."""
        self._call(
            self._library.bwd,
            self._transmittance,
            self._last,
            self._d_image,
            self._d_transmittance,
            *self._sinks,
        )

    def _call(self, function: Callable[..., int], *arrays: NDArray) -> None:
        s = self._scene
        inputs = (self._offsets, self._pairs, s.u, s.v, self._inverse_variance, s.opacity)
        function(
            self._channels,
            s.width,
            s.height,
            *_addresses(*inputs, self._reach, self._values, *arrays),
        )


def _addresses(*arrays: NDArray) -> list[ctypes.c_void_p]:
    return [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]


def compiled(source: Path, instruction_set: str, folder: Path) -> Path:
    """A rival's source as a shared library for an instruction set."""
    library = folder / f"{instruction_set}.so"
    flags = ["-O3", "-ffast-math", "-fopenmp", "-shared", "-fPIC"]
    target = f"-march={TARGETS[instruction_set]}"
    subprocess.run(["g++", *flags, target, str(source), "-o", str(library)], check=True)
    return library
