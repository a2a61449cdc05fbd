"""Interface of the rendering backends: a forward pass and its backward pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from toolkit.base.geometry.camera import Camera
from toolkit.base.native.constants import TILE
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.ellipsoids import Ellipsoids


@dataclass(frozen=True)
class GaussianGradients:
    """Gradients of the V visible Gaussians of a view and of the view's pose.

    Attributes:
        ids: [V] int64, ascending indices into the cloud; the gradients of all others are zero.
        means: [V, 3]. log_radii: [V]. opacity_logits: [V].
        colours: [V, 3], or None if not requested.
        features: [V, S].
        T_camera_map: [3, 4] float64, derivative with respect to each matrix entry.
        ellipsoids: of axes and harmonics, None for spheres; the log radii of ellipsoids have none.
    """

    ids: Tensor
    means: Tensor
    log_radii: Tensor
    opacity_logits: Tensor
    colours: Tensor | None
    features: Tensor
    T_camera_map: Tensor
    ellipsoids: Ellipsoids | None = None

    def by_name(self) -> dict[str, Tensor]:
        """Return those of the optimised tensors of `GaussianCloud.tensors`."""
        named = {
            "means": self.means,
            "opacity_logits": self.opacity_logits,
            "features": self.features,
        }
        if self.colours is not None:
            named["colours"] = self.colours
        if self.ellipsoids is None:
            return named | {"log_radii": self.log_radii}
        return named | self.ellipsoids.tensors()

    def to(self, device: torch.device) -> GaussianGradients:
        """Return the gradients on a device."""
        return GaussianGradients(
            self.ids.to(device),
            self.means.to(device),
            self.log_radii.to(device),
            self.opacity_logits.to(device),
            None if self.colours is None else self.colours.to(device),
            self.features.to(device),
            self.T_camera_map.to(device),
            self.ellipsoids and self.ellipsoids.mapped(lambda tensor: tensor.to(device)),
        )


class ForwardPass(Protocol):
    """One rendered view."""

    images: Tensor  # [5 + S, H, W], or [5 + S + 3, H, W] with centres; detached

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """Compute the gradients of a scalar loss; may be called once.

        Args:
            image_gradients: [5 + S, H, W] derivative of the loss with respect to the images, or
                [5, H, W] without the features. Centres have no gradient.
            colours: False skips the colour gradients (pose-only tracking).
            detached: the gradients of the feature channels are propagated to the features only;
                geometry, opacity and pose receive the gradients of colour and depth only.
        """
        ...


class Backend(Protocol):
    """Rendering backend."""

    name: str

    def forward(
        self,
        gaussians: GaussianCloud,
        camera: Camera,
        T_camera_map: NDArray[np.float64],
        features: Tensor | None,
        region: Tensor | None,
        centres: bool = False,
    ) -> ForwardPass:
        """Render the Gaussians; see `toolkit.splatting.rendering.render`.

        `centres` appends three channels with the composited means of the Gaussians.
        """
        ...


def tile_counts(camera: Camera) -> tuple[int, int]:
    """Return the number of tiles (rows, columns) that cover the camera's image."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def pixels_of_region(region: Tensor, height: int, width: int) -> Tensor:
    """Return the pixel mask [H, W] of a tile mask [rows, columns]."""
    return region.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]
