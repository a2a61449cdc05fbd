"""Options of the mapping loss."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.base.options import Fraction, NonNegativeFloat, PositiveFloat


@dataclass(frozen=True)
class RgbdLossWeights:
    """Weights of the colour and depth losses of mapping (Hier-SLAM++, equation 24)."""

    colour: NonNegativeFloat = 0.5
    """Weight of the colour loss (GauSem-SLAM: 1)."""
    depth: NonNegativeFloat = 1.0
    """Weight of the depth loss (GauSem-SLAM: 0.5)."""
    # Without it, black surfaces turn transparent, since the background is black.
    silhouette: NonNegativeFloat = 0.02
    """Weight of the silhouette loss, which closes gaps in measured surfaces."""
    structure: Fraction = 0.2
    """Fraction of SSIM in the colour loss."""
    # The papers' L1 is made quadratic near zero (Charbonnier): with its constant slope, Adam would
    # keep moving Gaussians that already fit.
    colour_scale: PositiveFloat = 0.02
    """Colour residual below which the loss is quadratic, for colours in [0, 1]."""
    depth_scale_m: PositiveFloat = 0.005
    """Depth residual at a depth of 1 m below which the loss is quadratic, in metres."""
    min_silhouette: Fraction = 0.5
    """Minimum silhouette of the pixels included in the depth loss."""
