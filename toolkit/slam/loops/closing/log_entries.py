"""Lines of `loops.jsonl`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.loops.closing.pair_matching import VerifiedPair
from toolkit.slam.loops.correction import PoseCorrection
from toolkit.slam.loops.registration.result import RegistrationResult

Array = NDArray[np.float64]
# Writes one line, from its kind and its values.
Record = Callable[[str, dict[str, Any]], None]


def correction_values(correction: PoseCorrection) -> dict[str, float]:
    """The largest pose change of a correction."""
    return {"largest_m": correction.largest_m, "largest_rad": correction.largest_rad}


def pair_values(pair: VerifiedPair) -> dict[str, Any]:
    """Matches and relative pose of two keyframes."""
    values: dict[str, Any] = {"matches": pair.matches}
    if pair.evidence is not None:
        values |= pair.evidence.values()
    if pair.offset is None:
        return values
    return values | {"visible": pair.offset.visible} | motion_values(pair.offset.T_first_second)


def motion_values(T_match_query: Array) -> dict[str, Any]:
    """Measured relative pose [4, 4] of two keyframes, as 16 numbers row by row."""
    return {
        "apart_m": float(np.linalg.norm(T_match_query[:3, 3])),
        "T_match_query": [float(value) for value in T_match_query.ravel()],
    }


def verdict(reason: str) -> dict[str, Any]:
    """Whether something was accepted, from the reason for rejecting it (empty if accepted)."""
    return {"accepted": not reason, "reason": reason}


def registration_values(result: RegistrationResult, T_before: Array) -> dict[str, Any]:
    """Quality of a registration, and its pose change from the initial pose [4, 4]."""
    change = se3.inverse(T_before) @ result.T_target_source
    return result.quality_values() | {
        "moved_m": float(np.linalg.norm(change[:3, 3])),
        "turned_rad": float(se3.rotation_angle_rad(change[:3, :3])),
    }
