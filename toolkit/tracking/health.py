"""Whether a tracked pose can be believed."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.data import INITIAL_SCALES, ResidualScales
from toolkit.frame import Frame
from toolkit.tracking.result import Health

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class HealthLimits:
    """Bounds beyond which a frame counts as lost.

    Attributes:
        least_measured: fewest frame pixels with depth.
        least_visible: smallest share of them that the map explains.
        most_intensity: largest photometric scale, intensities in [0, 1].
        most_depth_m: largest geometric scale at 1 m, metres.
        least_information: smallest eigenvalue of the information matrix (1 / m^2 or rad^2).
        most_misfit: largest product of both scales, in units of the frame before.
    """

    least_measured: int = 200
    least_visible: float = 0.15
    most_intensity: float = 0.15
    most_depth_m: float = 0.04
    least_information: float = 1e4
    most_misfit: float = 4.0


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
    elif measured < limits.least_measured:
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
    if measured < limits.least_measured:
        return Health.LOST, f"only {measured:.0f} pixels have depth"
    if visible_fraction < limits.least_visible:
        return Health.LOST, f"the map explains only {100 * visible_fraction:.0f} % of the frame"
    if scales.depth_m > limits.most_depth_m:
        return Health.LOST, f"depth disagrees by {100 * scales.depth_m:.1f} cm at 1 m"
    if scales.intensity > limits.most_intensity:
        return Health.LOST, f"intensity disagrees by {scales.intensity:.2f}"
    if not np.isfinite(information).all():
        return Health.LOST, "the images hold values that are not finite"
    weakest = float(np.linalg.eigvalsh(information)[0])
    if not weakest > limits.least_information:
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
    if misfit <= limits.most_misfit:
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
