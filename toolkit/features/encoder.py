"""What turns pictures into descriptors, and what every such encoder keeps to."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor


class Encoder(Protocol):
    """Describes pictures by vectors that are near for views of one place.

    Attributes:
        name: for logs and checkpoints.
        dimensions: length D of a descriptor.
        threshold: Euclidean distance of two descriptors (not its square) below which they may
            show the same place; of unit vectors, so cosine = 1 - threshold^2 / 2.
    """

    name: str
    dimensions: int
    threshold: float

    def describe(self, images: Tensor) -> Tensor:
        """Descriptors [B, D] float32 of unit length, differentiable in the images.

        The same images give the same bits on a CPU.

        Args:
            images: [B, 3, H, W] float32, RGB in [0, 1], of any size.

        Raises:
            ValueError: the shape is another.
        """
        ...


def check_images(images: Tensor) -> None:
    """See that images are a batch [B, 3, H, W] of floating-point numbers.

    Raises:
        ValueError: they are not.
    """
    if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point():
        raise ValueError(
            f"images must be floats of shape [B, 3, H, W], got {images.dtype} {list(images.shape)}"
        )


def unit_length(vectors: Tensor) -> Tensor:
    """Vectors [..., D] scaled to length 1; zeros stay zeros."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(1e-12)
