"""Whether a frame can start the map, and the residual scales that follow lost frames."""

from __future__ import annotations

import logging

import numpy as np

from toolkit.base.frame import Frame
from toolkit.splatting.alignment.data import INITIAL_SCALES, ResidualScales
from toolkit.splatting.alignment.health import HealthLimits

_log = logging.getLogger(__name__)

# Growth of the scales with every lost frame, up to the initial ones: the alignment of the next
# frame starts with larger errors.
_RELAXATION = 1.25
# Intensity (0-1) that the noise of a covered sensor does not reach, and the share of pixels that do
# in the darkest image that shows anything. Overexposed images are as far from white.
_NOISE, _MIN_SHOWN = 0.05, 0.005
# Colours are at most 1; this is far beyond what interpolation adds, and below those of 8 bits.
_MAX_COLOUR = 2.0


def may_start_map(limits: HealthLimits, frame: Frame) -> bool:
    """Whether a map can start at a frame; otherwise a warning with the reason is logged."""
    measured = int((np.isfinite(frame.depth_m) & (frame.depth_m > 0)).sum())
    if not np.isfinite(frame.rgb).all():
        reason = "its colour image contains values that are not finite"
    elif frame.rgb.max() > _MAX_COLOUR:
        reason = f"its colours reach {frame.rgb.max():.4g}, but must be between 0 and 1"
    elif measured < limits.min_measured:
        reason = f"only {measured} pixels have depth"
    elif is_blank(frame):
        reason = "its colour image is blank (black, white or saturated everywhere)"
    else:
        return True
    _log.warning("Frame %d cannot start the map: %s.", frame.index, reason)
    return False


def is_blank(frame: Frame) -> bool:
    """Whether a colour image shows nothing: all channels are 0 or saturated everywhere.

    Such are images under a lens cap, before the first exposure, or towards a lamp.
    """
    colours = frame.rgb[::4, ::4].reshape(-1, 3)
    shown = np.abs(colours - np.median(colours, axis=0).round()) > _NOISE
    return bool(shown.any(axis=-1).mean() < _MIN_SHOWN)


def has_depth(frame: Frame) -> bool:
    """Whether any pixel has depth. Frames of a covered lens have none and cannot be located."""
    return bool((frame.depth_m > 0).any())


def relaxed_scales(scales: ResidualScales) -> ResidualScales:
    """Initial scales of the next frame after a lost one."""
    return ResidualScales(
        max(scales.intensity, min(_RELAXATION * scales.intensity, INITIAL_SCALES.intensity)),
        max(scales.depth_m, min(_RELAXATION * scales.depth_m, INITIAL_SCALES.depth_m)),
    )
