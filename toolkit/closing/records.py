"""Lines of `loops.jsonl`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.pose_graph.correction import PoseCorrection
from toolkit.registration.result import RegistrationResult

Array = NDArray[np.float64]
# Writes a line of a kind.
Record = Callable[[str, dict[str, Any]], None]


def moved_by(correction: PoseCorrection) -> dict[str, float]:
    return {"largest_m": correction.largest_m, "largest_rad": correction.largest_rad}


def verdict(reason: str) -> dict[str, Any]:
    return {"accepted": not reason, "reason": reason}


def figures_of(result: RegistrationResult, T_before: Array) -> dict[str, Any]:
    """A registration for the log."""
    change = se3.inverse(T_before) @ result.T_target_source
    return result.figures() | {
        "moved_m": float(np.linalg.norm(change[:3, 3])),
        "turned_rad": float(se3.rotation_angle_rad(change[:3, :3])),
    }
