"""Interface of the image encoders."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Encoder(Protocol):
    """Computes image descriptors whose distance is small for views of the same place.

    Attributes:
        name: name for logs and checkpoints.
        dimensions: descriptor dimension D.
        threshold: maximum Euclidean distance (not squared) of descriptors of the same place.
            Descriptors are unit vectors, so the cosine is 1 - threshold^2 / 2.
        differentiable: whether descriptors have gradients with respect to the images.
    """

    name: str
    dimensions: int
    threshold: float
    differentiable: bool

    def describe(self, images: Tensor) -> Tensor:
        """Compute descriptors [B, D] float32 of unit norm.

        Results are reproducible on a CPU.

        Args:
            images: [B, 3, H, W] float32, RGB in [0, 1], of any size.

        Raises:
            ValueError: the images have a different shape.
        """
        ...


def check_images(images: Tensor) -> None:
    """Check that images are a floating-point batch [B, 3, H, W].

    Raises:
        ValueError: the shape or dtype is wrong.
    """
    if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point():
        raise ValueError(
            f"images must be floats of shape [B, 3, H, W], got {images.dtype} {list(images.shape)}"
        )


def unit_length(vectors: Tensor) -> Tensor:
    """Normalise vectors [..., D] to unit norm; zero vectors are unchanged."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12)
