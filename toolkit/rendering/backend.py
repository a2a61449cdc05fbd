"""What every rendering backend offers: a forward pass and, later, its backward pass."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry.camera import Camera
from toolkit.native.constants import TILE


@dataclass(frozen=True)
class GaussianGradients:
    """Gradients of the V Gaussians that a view shows, and of the view's pose.

    Attributes:
        ids: [V] int64, ascending indices into the cloud; all others have gradient zero.
        means: [V, 3]. log_radii: [V]. opacity_logits: [V].
        colours: [V, 3], or None where nobody asked.
        features: [V, S].
        T_camera_map: [3, 4] float64, derivative by each matrix entry.
    """

    ids: Tensor
    means: Tensor
    log_radii: Tensor
    opacity_logits: Tensor
    colours: Tensor | None
    features: Tensor
    T_camera_map: Tensor


class ForwardPass(Protocol):
    """One drawn view."""

    images: Tensor  # [5 + S, H, W], or [5 + S + 3, H, W] with centres; detached

    def backward(
        self, image_gradients: Tensor, colours: bool = True, detached: bool = False
    ) -> GaussianGradients:
        """Gradients of a scalar whose derivative by the images [5 + S, H, W] is given.

        May be called once. `colours=False` skips the colour gradients (pose-only tracking);
        gradients for the first five images alone leave the features out. `detached`: what the
        feature channels ask for goes to the features alone, so that geometry, opacity and pose
        hear of colour and depth only. Centres have no gradient.
        """
        ...


class Backend(Protocol):
    """Draws views."""

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
        """Draw the Gaussians as seen from the camera; see `toolkit.rendering.render`.

        `centres` composites the Gaussians' means as three more channels, the last ones.
        """
        ...


def tile_counts(camera: Camera) -> tuple[int, int]:
    """(rows, columns) of tiles that cover the camera's image."""
    return -(-camera.height // TILE), -(-camera.width // TILE)


def pixels_of_region(region: Tensor, height: int, width: int) -> Tensor:
    """Mask [H, W] of the pixels of tiles [rows, columns]."""
    return region.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[:height, :width]
