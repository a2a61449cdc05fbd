"""Kernel parameters that affect speed, memory and rounding."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import triton


@dataclass(frozen=True)
class Tuning:
    """Kernel parameters that affect speed, memory and rounding.

    They are fixed instead of tuned at run time, because a selection by timing would change the
    order of sums between runs.

    Attributes:
        side: side of a tile in pixels, 8 or 16.
        batch: number of Gaussians composited at once, a power of two >= 16.
        channels_forward, channels_backward: maximum number of feature channels per block, powers
            of two >= 16. The backward kernel always uses the maximum, because narrow matrix
            products spill registers.
        warps, narrow_warps: number of warps of the compositing kernels. The latter is used for at
            most 32 feature channels (forward) or none (backward). Two warps cover the 64 pixels
            of a tile, so that scans and sums over a batch need no barrier.
        precision: Triton's input precision of matrix products. "tf32" rounds features, weights
            and image gradients to 11 bits; "tf32x3" and "ieee" keep float32 and are slower.
            Colour, depth, silhouette, centres and the moments for the gradients of means and
            radii are always float32.
        scratch_bytes: maximum memory for the feature gradients of all pairs. Channels are
            processed in parts that fit; each part computes all alphas again.
    """

    side: int = 8
    batch: int = 16
    channels_forward: int = 128
    channels_backward: int = 32
    warps: int = 4
    narrow_warps: int = 2
    precision: Literal["tf32", "tf32x3", "ieee"] = "tf32"
    scratch_bytes: int = 2**32

    def forward_warps(self, block: int) -> int:
        """Return the number of warps of the forward kernel for a block of feature channels."""
        return self.narrow_warps if block <= 32 else self.warps

    def backward_warps(self, channels: int) -> int:
        """Return the number of warps of the backward kernel for a number of feature channels."""
        return self.narrow_warps if channels == 0 else self.warps

    def channels_at_once(self, pairs: int) -> int:
        """Return how many channels fit in the scratch memory, rounded down to whole blocks."""
        most = max(1, self.scratch_bytes // (4 * max(1, pairs)))
        block = self.channels_backward
        return most if most < block else most - most % block


def block_of(channels: int, most: int) -> int:
    """Return the number of feature channels per block: a power of two >= 16, or 0 for none."""
    return 0 if channels == 0 else min(most, max(16, triton.next_power_of_2(channels)))
