"""Rendering backend of the Triton kernels."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace

import numpy as np
import torch
import triton
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import BASE_CHANNELS
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering.backend import ForwardPass, GaussianGradients
from toolkit.splatting.rendering.cuda import compositing, differentiation, ellipsoids, reduction
from toolkit.splatting.rendering.cuda.binning import Binning, bin_gaussians
from toolkit.splatting.rendering.cuda.tuning import Tuning, block_of
from toolkit.splatting.rendering.device_transfer import TransferredForwardPass

_SUMS, _SHAPED_SUMS = int(differentiation.SUMS.value), int(differentiation.SHAPED_SUMS.value)
_REDUCED = 64  # Gaussians per program of the final reduction
_ADDED = 16  # Gaussians per program that adds rows of gradients


def on(device: torch.device) -> contextlib.AbstractContextManager[None]:
    """Make a device current, because kernels are launched on the current device."""
    return torch.cuda.device(device) if device.type == "cuda" else contextlib.nullcontext()


@dataclass(frozen=True)
class _ForwardState:
    """State of the forward pass for the backward pass, in addition to the images."""

    checkpoints: Tensor
    transmittance: Tensor
    batches: Tensor


class CudaForwardPass:
    """A view rendered by the Triton kernels, with the state for its backward pass."""

    def __init__(
        self,
        cloud: GaussianCloud,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        binning: Binning,
        tuning: Tuning,
    ):
        self._cloud, self._camera, self._T_camera_map = cloud, camera, T_camera_map
        self._shaped = ellipsoids.is_shaped(cloud)
        self._binning, self._tuning = binning, tuning
        self.images = cloud.means.new_empty(0)
        self._forward_state: _ForwardState | None = None

    @property
    def _channels(self) -> int:
        return self._cloud.features.shape[1]

    def render(self, centres: bool) -> None:
        """Render into `images`."""
        bins, camera, tuning = self._binning, self._camera, self._tuning
        channels, device = self._channels, bins.view.device
        planes = BASE_CHANNELS + channels + (3 if centres else 0)
        empty = self._cloud.means.new_empty
        self.images = empty(planes, camera.height, camera.width)
        pixels = tuning.side**2
        self._forward_state = _ForwardState(
            empty(len(bins.rows) // tuning.batch + bins.tiles, pixels),
            empty(bins.tiles, pixels),
            torch.empty(bins.tiles, dtype=torch.int32, device=device),
        )
        block = block_of(channels, tuning.channels_forward)
        compositing.composite[(bins.tiles, triton.cdiv(channels, block) if block else 1)](
            bins.splats,
            self._cloud.features,
            self._cloud.means,
            bins.gaussians,
            bins.tile_begins,
            self.images,
            self.images[BASE_CHANNELS + channels :] if centres else self.images,
            self._forward_state.checkpoints,
            self._forward_state.transmittance,
            self._forward_state.batches,
            camera.width,
            camera.height,
            channels,
            SIDE=tuning.side,
            BATCH=tuning.batch,
            BLOCK_C=block,
            CENTRES=centres,
            SHAPED=self._shaped,
            PRECISION=tuning.precision,
            num_warps=tuning.forward_warps(block),
        )

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """See ForwardPass.backward."""
        bins, device = self._binning, self._binning.view.device
        channels = 0 if len(image_gradients) == BASE_CHANNELS else self._channels
        expected = (BASE_CHANNELS + channels, *self.images.shape[1:])
        if image_gradients.shape != expected:
            raise ValueError(
                f"image gradients must have shape {list(expected)}, "
                f"got {list(image_gradients.shape)}"
            )
        by_images = image_gradients.detach().to(device, torch.float32).contiguous()
        visible = len(bins.ids)
        features = by_images.new_empty(visible, channels)
        width = _SHAPED_SUMS if self._shaped else _SUMS
        # The tiles of ellipsoids do not write all rows; see `list_pairs`.
        create = features.new_zeros if self._shaped else features.new_empty
        sums = create(len(bins.rows), width)
        if not visible:
            return self._finished(sums, features, colours)
        with on(device):
            width = self._tuning.channels_at_once(len(bins.rows))
            for first in range(0, max(1, channels), width):
                last = min(first + width, channels)
                rows = create(len(bins.rows), last - first, device=device)
                self._differentiate(by_images, sums, rows, (first, last, channels), not detached)
                self._add_rows(rows, features, first)
            return self._finished(sums, features, colours)

    def _differentiate(
        self,
        by_images: Tensor,
        sums: Tensor,
        rows: Tensor,
        span: tuple[int, int, int],
        move: bool,
    ) -> None:
        """Compute the feature rows of channels first to last and, in the first call, the sums."""
        bins, camera, tuning, state = self._binning, self._camera, self._tuning, self._forward_state
        assert state is not None
        first, last, channels = span
        differentiation.differentiate[(bins.tiles,)](
            bins.splats,
            self._cloud.features,
            bins.gaussians,
            bins.rows,
            bins.tile_begins,
            state.checkpoints,
            state.transmittance,
            state.batches,
            by_images,
            sums,
            rows,
            camera.width,
            camera.height,
            channels,
            first,
            last,
            SIDE=tuning.side,
            BATCH=tuning.batch,
            BLOCK_C=tuning.channels_backward if channels else 0,
            GEOMETRY=first == 0,
            MOVE=move and first == 0 and channels > 0,
            SHAPED=self._shaped,
            PRECISION=tuning.precision,
            num_warps=tuning.backward_warps(channels),
        )

    def _add_rows(self, rows: Tensor, features: Tensor, first: int) -> None:
        bins, (visible, channels), width = self._binning, features.shape, rows.shape[1]
        if width == 0:
            return
        block = block_of(width, 64)
        reduction.add_rows[(triton.cdiv(visible, _ADDED), triton.cdiv(width, block))](
            bins.begins,
            bins.counts,
            rows,
            features,
            visible,
            width,
            channels,
            first,
            BLOCK=_ADDED,
            BLOCK_C=block,
        )

    def _finished(self, sums: Tensor, features: Tensor, colours: bool) -> GaussianGradients:
        """Apply the chain rule to the sums of the pairs: gradients of parameters and pose."""
        if self._shaped:
            return self._finished_shapes(sums, features, colours)
        bins, device, visible = self._binning, sums.device, len(self._binning.ids)
        blocks = triton.cdiv(visible, _REDUCED)
        pose = torch.zeros(max(1, blocks), 12, dtype=torch.float64, device=device)
        by_colours = sums.new_empty(visible, 3) if colours else None
        means = sums.new_empty(visible, 3)
        log_radii = sums.new_empty(visible)
        opacity_logits = sums.new_empty(visible)
        if visible:
            reduction.finish[(blocks,)](
                bins.view,
                self._cloud.means,
                bins.splats,
                bins.ids,
                bins.begins,
                bins.counts,
                bins.row_tiles,
                sums,
                means,
                log_radii,
                opacity_logits,
                means if by_colours is None else by_colours,
                pose,
                visible,
                bins.columns,
                SIDE=self._tuning.side,
                COLOURS=colours,
                BLOCK=_REDUCED,
                num_warps=_REDUCED // 32,
            )
        return GaussianGradients(
            ids=bins.ids,
            means=means,
            log_radii=log_radii,
            opacity_logits=opacity_logits,
            colours=by_colours,
            features=features,
            T_camera_map=pose.sum(dim=0).view(3, 4),
        )

    def _finished_shapes(self, sums: Tensor, features: Tensor, colours: bool) -> GaussianGradients:
        totals = sums.new_empty(len(self._binning.ids), _SHAPED_SUMS)
        if len(totals):
            self._add_rows(sums, totals, 0)
        found = ellipsoids.gradients_of(
            self._cloud, self._camera, self._T_camera_map, self._binning.ids, totals
        )
        return replace(found, colours=found.colours if colours else None, features=features)


def interpreted() -> bool:
    """Check whether Triton interprets kernels (TRITON_INTERPRET=1 was set at import)."""
    return not isinstance(compositing.composite, triton.JITFunction)


class CudaRenderer:
    """Triton kernels on the GPU that stores the Gaussians, or on the first GPU."""

    name = "cuda"

    def __init__(self, tuning: Tuning | None = None) -> None:
        self._tuning = tuning or Tuning()

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
        home = gaussians.means.device
        device = home if home.type == "cuda" or interpreted() else torch.device("cuda")
        if features is None:
            features = gaussians.means.new_zeros(len(gaussians), 0)
        cloud = replace(gaussians, features=features).mapped(
            lambda tensor: tensor.detach().to(device, torch.float32).contiguous()
        )
        region = None if region is None else region.to(device, torch.uint8).contiguous()
        with on(device):
            binning = bin_gaussians(cloud, camera, T_camera_map, region, self._tuning.side)
            forward_pass = CudaForwardPass(cloud, camera, T_camera_map, binning, self._tuning)
            forward_pass.render(centres)
        return forward_pass if device == home else TransferredForwardPass(forward_pass, home)
