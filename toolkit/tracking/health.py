"""Whether a frame can start the map, and whether the fit of a tracked frame is plausible."""

from __future__ import annotations

import logging

import numpy as np

from toolkit.alignment.data import INITIAL_SCALES, ResidualScales
from toolkit.alignment.options import HealthLimits
from toolkit.frame import Frame

_log = logging.getLogger(__name__)

# Smaller scales do not predict those of the next frame: on ideal images the residuals can grow
# several times where the map is new.
_USUAL_SCALES = ResidualScales(intensity=0.01, depth_m=0.0015)
# Growth of the scales with every lost frame, up to the initial ones: the alignment of the next
# frame starts with larger errors.
_RELAXATION = 1.25
# Maximum growth of the reference that a frame's scales are compared with. Some growth is needed,
# because the scene may have become harder to fit. After a covered lens, tracking ended a metre off
# with 11 times the photometric scale (twin rooms).
_MAX_RELAXATION = 1.6


def may_start_map(limits: HealthLimits, frame: Frame) -> bool:
    """Whether a map can start at a frame; otherwise a warning with the reason is logged."""
    measured = int((np.isfinite(frame.depth_m) & (frame.depth_m > 0)).sum())
    if not np.isfinite(frame.rgb).all():
        reason = "its colour image contains values that are not finite"
    elif measured < limits.min_measured:
        reason = f"only {measured} pixels have depth"
    else:
        return True
    _log.warning("Frame %d cannot start the map: %s.", frame.index, reason)
    return False


def misfit_reason(limits: HealthLimits, found: ResidualScales, reference: ResidualScales) -> str:
    """Why a converged alignment is wrong, compared with previous residuals; empty if it is right.

    Alignment to a wrong place of similar shape converges with moderate residuals, but they are
    much larger than those of the previous frame: 5.2 times after a motion of 55 cm (every eighth
    frame of RedKitchen), but below 3.1 times in all tracked frames of the real recordings.

    Args:
        found: residual scales of the frame.
        reference: scales to compare with, see `reference_scales`.
    """
    usual = _USUAL_SCALES
    reference_product = max(reference.intensity, usual.intensity) * max(
        reference.depth_m, usual.depth_m
    )
    misfit = found.intensity * found.depth_m / reference_product
    if misfit <= limits.max_residual_ratio:
        return ""
    return f"it fits {misfit:.1f} times worse than the frame before"


def has_depth(frame: Frame) -> bool:
    """Whether any pixel has depth. Frames of a covered lens have none and cannot be located."""
    return bool((frame.depth_m > 0).any())


def reference_scales(scales: ResidualScales, fit: ResidualScales) -> ResidualScales:
    """Reference for a frame's scales: those of the last tracked frame, larger after lost frames.

    Args:
        scales: current scales, after `relaxed_scales`.
        fit: scales of the last tracked frame.
    """
    usual = _USUAL_SCALES
    return ResidualScales(
        min(scales.intensity, _MAX_RELAXATION * max(fit.intensity, usual.intensity)),
        min(scales.depth_m, _MAX_RELAXATION * max(fit.depth_m, usual.depth_m)),
    )


def relaxed_scales(scales: ResidualScales) -> ResidualScales:
    """Initial scales of the next frame after a lost one."""
    return ResidualScales(
        max(scales.intensity, min(_RELAXATION * scales.intensity, INITIAL_SCALES.intensity)),
        max(scales.depth_m, min(_RELAXATION * scales.depth_m, INITIAL_SCALES.depth_m)),
    )
