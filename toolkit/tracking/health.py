"""Whether a tracked pose can be believed."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import INITIAL_SCALES, ResidualScales
from toolkit.frame import Frame
from toolkit.tracking.options import HealthLimits
from toolkit.tracking.result import Health

_log = logging.getLogger(__name__)

# Smaller scales do not predict those of the next frame: on ideal images the fit can become
# several times worse where the map is new.
_USUAL_SCALES = ResidualScales(intensity=0.01, depth_m=0.0015)
# By so much the scales grow with each lost frame, up to those of a first frame, since alignment
# from farther off begins with larger errors.
_FORGETTING = 1.25
# But what is believed then may fit only so many times worse in each: the scene itself may have
# become harder to fit. After a covered lens, tracking ended a metre off with 11 times the
# photometric scale (twin rooms).
_MOST_FORGOTTEN = 1.6


def may_start_map(limits: HealthLimits, frame: Frame) -> bool:
    """Whether a map can begin with a frame; a warning says what is wrong with it."""
    measured = int((np.isfinite(frame.depth_m) & (frame.depth_m > 0)).sum())
    if not np.isfinite(frame.rgb).all():
        fault = "its colour holds values that are not finite"
    elif measured < limits.min_measured:
        fault = f"only {measured} pixels have depth"
    else:
        return True
    _log.warning("frame %d cannot start the map: %s", frame.index, fault)
    return False


def verdict(
    limits: HealthLimits,
    scales: ResidualScales,
    visible_fraction: float,
    information: NDArray[np.float64],
    measured: float,
) -> tuple[Health, str]:
    """GOOD, or LOST with the reason in plain words."""
    if measured < limits.min_measured:
        return Health.LOST, f"only {measured:.0f} pixels have depth"
    if visible_fraction < limits.min_visible:
        return Health.LOST, f"the map explains only {100 * visible_fraction:.0f} % of the frame"
    if scales.depth_m > limits.max_depth_residual_m:
        return Health.LOST, f"depth disagrees by {100 * scales.depth_m:.1f} cm at 1 m"
    if scales.intensity > limits.max_intensity_residual:
        return Health.LOST, f"intensity disagrees by {scales.intensity:.2f}"
    if not np.isfinite(information).all():
        return Health.LOST, "the images hold values that are not finite"
    weakest = float(np.linalg.eigvalsh(information)[0])
    if not weakest > limits.min_information:
        return Health.LOST, f"the view does not fix the pose (information {weakest:.1e})"
    return Health.GOOD, ""


def gone_astray(limits: HealthLimits, found: ResidualScales, before: ResidualScales) -> str:
    """Why a frame that looks tracked is not, by the fit of the frame before; empty if it is.

    Alignment that slides into another place of similar shape ends with a small step and a fair
    fit, but a far worse one than the frame before had: 5.2 times at a jump of 55 cm (every eighth
    frame of RedKitchen), below 3.1 in all frames of the real recordings that were tracked.
    """
    usual = _USUAL_SCALES
    before_product = max(before.intensity, usual.intensity) * max(before.depth_m, usual.depth_m)
    misfit = found.intensity * found.depth_m / before_product
    if misfit <= limits.max_residual_ratio:
        return ""
    return f"it fits {misfit:.1f} times worse than the frame before"


def shows_something(frame: Frame) -> bool:
    """Whether any pixel has depth: a covered lens says nothing about where the camera is."""
    return bool((frame.depth_m > 0).any())


def believable(scales: ResidualScales, fit: ResidualScales) -> ResidualScales:
    """What to hold a frame's scales against: the last tracked frame's, wider after lost ones.

    Args:
        scales: after `forgetting`. fit: of the last tracked frame.
    """
    usual = _USUAL_SCALES
    return ResidualScales(
        min(scales.intensity, _MOST_FORGOTTEN * max(fit.intensity, usual.intensity)),
        min(scales.depth_m, _MOST_FORGOTTEN * max(fit.depth_m, usual.depth_m)),
    )


def forgetting(scales: ResidualScales) -> ResidualScales:
    """The scales that alignment of the next frame begins with after a lost one."""
    return ResidualScales(
        max(scales.intensity, min(_FORGETTING * scales.intensity, INITIAL_SCALES.intensity)),
        max(scales.depth_m, min(_FORGETTING * scales.depth_m, INITIAL_SCALES.depth_m)),
    )
