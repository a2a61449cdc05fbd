"""Velocity of the camera at the start of a sequence, from its first two frames."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.slam.tracking.rolling_shutter import velocity_between
from toolkit.splatting.alignment.joint import Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import finest_level, model_level, pyramid


def initial_velocity(first: Frame, second: Frame) -> NDArray[np.float64] | None:
    """Estimate the velocity from two frames, which a rolling shutter has bent alike.

    Args:
        first, second: with depth, and increasing timestamps.

    Returns:
        [6] m/s and rad/s in the camera's frame; None if the frames cannot be aligned.
    """
    options = JointOptions()
    before, after = (
        pyramid(finest_level(frame, torch.device("cpu")), options.levels)
        for frame in (first, second)
    )
    pair = Pair([model_level(level) for level in before], after, np.eye(4), np.eye(4))
    found = align([pair], Estimate(np.eye(4)), options)
    if not found.converged:
        return None
    elapsed_s = second.timestamp_s - first.timestamp_s
    return velocity_between(np.eye(4), found.T_target_source, elapsed_s)
