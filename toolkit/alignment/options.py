"""Options of alignment."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.options import Fraction, NonNegativeFloat, PositiveFloat, PositiveInt


@dataclass(frozen=True)
class HealthLimits:
    """Limits beyond which a tracked frame counts as lost."""

    min_measured: PositiveInt = 200
    """Minimum number of pixels with a depth measurement."""
    min_visible: Fraction = 0.15
    """Minimum fraction of the measured pixels that the map explains."""
    max_intensity_residual: PositiveFloat = 0.15
    """Maximum robust scale of the photometric residuals, for intensities in [0, 1]."""
    max_depth_residual_m: PositiveFloat = 0.04
    """Maximum robust scale of the depth residuals at a depth of 1 m, in metres."""
    min_information: NonNegativeFloat = 1e4
    """Minimum eigenvalue of the pose's information matrix, in 1/m^2 and 1/rad^2."""
    max_residual_ratio: PositiveFloat = 4.0
    """Maximum product of the photometric and the depth scale, relative to the previous frame."""
