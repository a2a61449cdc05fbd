"""Frames whose pose is wrong although the method that found it does not say so."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from benchmarks.shared.tables import Metrics
from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error

Array = NDArray[np.float64]

# A motion between two frames that is off by more is wrong.
MAX_TRANSLATION_M, MAX_ROTATION_DEG = 0.05, 2.0
# Fewer poses determine no alignment.
_MIN_POSES = 3


@dataclass(frozen=True)
class TruthError:
    """Errors of the true motion between two frames.

    Attributes:
        translation_m: metres. rotation_deg: degrees.
    """

    translation_m: float = 0.0
    rotation_deg: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """What a method found.

    Attributes:
        timestamps_s: [N] of all frames.
        T_world_camera: [4, 4] by index of the frame, in the order of the frames.
        part: number of the part of each frame with a pose; the relative poses of different parts
            are unknown. Part 0 has the most frames.
        lost: frames without a pose, or whose pose the method reports to be a guess.
        doubtful: frames whose pose the method reports to be possibly wrong.
        figures: further results.
    """

    timestamps_s: Array
    T_world_camera: Mapping[int, Array]
    part: Mapping[int, int]
    lost: frozenset[int] = frozenset()
    doubtful: frozenset[int] = frozenset()
    figures: Metrics = field(default_factory=dict)

    @property
    def trusted(self) -> list[int]:
        """Frames with a pose that the method does not question, in order."""
        questioned = self.lost | self.doubtful
        return [index for index in self.T_world_camera if index not in questioned]


def motion_metrics(
    estimate: Estimate, truth: Mapping[int, Array], error: TruthError = TruthError()
) -> Metrics:
    """Figures of one method.

    Args:
        truth: [4, 4] poses by index of the frame.
        error: of the truth.

    Returns:
        `ate_cm` of part 0 after SE(3) alignment, None for fewer than three poses; and the number of
        frames, of those that are lost, doubtful and silently wrong, and of the parts.
    """
    return {
        "ate_cm": _ate_cm(estimate, truth),
        "frames": len(estimate.timestamps_s),
        "frames_lost": len(estimate.lost),
        "frames_doubtful": len(estimate.doubtful),
        "parts": len(set(estimate.part.values())),
        "silently_wrong": len(silently_wrong(estimate, truth, error)),
        **estimate.figures,
    }


def silently_wrong(
    estimate: Estimate,
    truth: Mapping[int, Array],
    error: TruthError = TruthError(),
    scenes: Sequence[int] | None = None,
) -> list[int]:
    """Trusted frames whose pose is wrong relative to the trusted frame before them.

    The frame before is the last one of the same part, and of the same scene. It is wrong if the
    motion between them is off by more than 5 cm or 2 degrees, and the error of the truth.

    Args:
        truth: [4, 4] poses by index of the frame; frames without are left out.
        error: of the truth.
        scenes: of each frame; one scene by default.
    """
    wrong = []
    before: dict[tuple[int, int], int] = {}
    for index in (i for i in estimate.trusted if i in truth):
        place = (estimate.part[index], 0 if scenes is None else scenes[index])
        last = before.get(place)
        before[place] = index
        if last is None:
            continue
        true = se3.inverse(truth[last]) @ truth[index]
        found = se3.inverse(estimate.T_world_camera[last]) @ estimate.T_world_camera[index]
        off = se3.inverse(true) @ found
        angle_deg = np.degrees(se3.rotation_angle_rad(off[:3, :3]))
        if (
            np.linalg.norm(off[:3, 3]) > MAX_TRANSLATION_M + error.translation_m
            or angle_deg > MAX_ROTATION_DEG + error.rotation_deg
        ):
            wrong.append(index)
    return wrong


def in_wrong_part(estimate: Estimate, scenes: Sequence[int]) -> list[int]:
    """Trusted frames in a part of which most trusted frames show another scene."""
    trusted = estimate.trusted
    shown: dict[int, Counter[int]] = {}
    for index in trusted:
        shown.setdefault(estimate.part[index], Counter())[scenes[index]] += 1
    usual = {part: counts.most_common(1)[0][0] for part, counts in shown.items()}
    return [index for index in trusted if scenes[index] != usual[estimate.part[index]]]


def _ate_cm(estimate: Estimate, truth: Mapping[int, Array]) -> float | None:
    found = [i for i in estimate.T_world_camera if estimate.part[i] == 0 and i in truth]
    if len(found) < _MIN_POSES:
        return None
    times_s = estimate.timestamps_s[found]
    poses = Trajectory(times_s, np.array([estimate.T_world_camera[i] for i in found]))
    true = Trajectory(times_s, np.array([truth[i] for i in found]))
    return 100.0 * absolute_trajectory_error(poses, true).rmse_m
