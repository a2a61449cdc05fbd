"""Submap allocation (G-III.A): start a submap when overlap and classes change, or at a size limit.

The rule "motion" of other submap systems is included for comparison: it depends only on the
camera's motion from the anchor.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.frustum import inside_frustum
from toolkit.base.keyframe import Keyframe
from toolkit.semantics.histograms import class_histogram, smoothed_kl
from toolkit.slam.submaps.options import AllocationOptions

# Fraction of a view inside the submap's volume below which it is spatially new (G: 0.5).
_MIN_OVERLAP = 0.5
# KL divergence in nats from which a view is semantically new with many classes (G: 0.4).
_MIN_DIVERGENCE = 0.4
# Distance from the anchor that starts a new submap by the rule motion.
_MOVED_M, _TURNED_DEG = 0.5, 50.0


def view_overlap(keyframe: Keyframe, others: Sequence[Keyframe]) -> float:
    """Fraction of a keyframe's observed points inside the union of viewing volumes (r_olap).

    A viewing volume is the part of a camera's frustum in front of the surface that the camera
    measured, so it does not extend through walls.

    Args:
        others: keyframes of the same submap.

    Returns:
        Value in [0, 1]; 0 if the keyframe observed no points.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    remaining = keyframe.points_in_map()
    count = len(remaining)
    # The latest keyframes see most of the view; few others are then tested.
    for other in reversed(others):
        if not len(remaining):
            break
        points = se3.transform_points(se3.inverse(other.T_map_camera), remaining)
        inside = inside_frustum(other.camera, points)
        inside[inside] = other.in_front_of_surface(points[inside])
        remaining = remaining[~inside]
    return 1.0 - len(remaining) / count if count else 0.0


@dataclass(frozen=True)
class AllocationVerdict:
    """Decision at one keyframe.

    Attributes:
        index: the keyframe's frame index.
        submap: number of the submap that the keyframe was compared with.
        overlap: fraction of the observed surface inside the submap's volume.
        divergence: KL divergence from the anchor's classes in nats; nan without labels.
        reason: why a new submap starts at this keyframe; empty if none starts.
    """

    index: int
    submap: int
    overlap: float
    divergence: float
    reason: str

    @property
    def starts_submap(self) -> bool:
        """Whether a new submap starts at this keyframe."""
        return bool(self.reason)

    def values(self) -> dict[str, Any]:
        """JSON values: nan becomes None."""
        known = not math.isnan(self.divergence)
        return {**asdict(self), "divergence": self.divergence if known else None}

    @classmethod
    def from_values(cls, values: dict[str, Any]) -> AllocationVerdict:
        """Restore a verdict from its `values`."""
        divergence = values["divergence"]
        return cls(**{**values, "divergence": math.nan if divergence is None else divergence})


class Allocation:
    """Spatial and semantic allocation with size limits.

    Args:
        num_classes: number of classes of the taxonomy; 0 for a map without labels.
    """

    def __init__(self, options: AllocationOptions, num_classes: int) -> None:
        self.options = options
        given = options.min_divergence
        self._min_divergence = _MIN_DIVERGENCE if given is None else given
        self._num_classes = num_classes

    def judge(self, number: int, keyframes: list[Keyframe], gaussians: int) -> AllocationVerdict:
        """Decide whether the newest keyframe of a submap starts a new submap.

        Args:
            number: the submap's number.
            keyframes: the submap's keyframes, the anchor first.
            gaussians: number of Gaussians in the submap.
        """
        newest = keyframes[-1]
        overlap = view_overlap(newest, self.established(keyframes))
        divergence = self._divergence(newest, keyframes[0])
        reason = self.limit(keyframes, gaussians) or self._left(keyframes, overlap, divergence)
        return AllocationVerdict(newest.index, number, overlap, divergence, reason)

    def established(self, keyframes: list[Keyframe]) -> list[Keyframe]:
        """The keyframes that a view is compared with: not the newest, which see most of it."""
        return keyframes[: max(1, len(keyframes) - self.options.recent)]

    def limit(self, keyframes: list[Keyframe], gaussians: int) -> str:
        """The limit of its size that a submap has reached; empty if it has reached none."""
        if len(keyframes) >= self.options.max_keyframes:
            return f"{len(keyframes)} keyframes"
        if gaussians >= self.options.max_gaussians:
            return f"{gaussians} Gaussians"
        path_m = path_length_m(keyframes)
        return f"a path of {path_m:.1f} m" if path_m >= self.options.max_path_m else ""

    def _left(self, keyframes: list[Keyframe], overlap: float, divergence: float) -> str:
        """Why the newest keyframe has left the submap; empty if it has not."""
        options = self.options
        if self.has_enough(keyframes) and overlap < _MIN_OVERLAP:
            return f"{len(keyframes)} keyframes and overlap {overlap:.2f}"
        if options.rule == "motion":
            return self._far_from_anchor(keyframes)
        if len(keyframes) >= options.min_keyframes:
            return self._new_view(overlap, divergence)
        return ""

    def has_enough(self, keyframes: Sequence[Keyframe]) -> bool:
        """Whether a submap should only get keyframes of what it does not show yet."""
        return len(keyframes) >= self.options.enough_keyframes

    def _new_view(self, overlap: float, divergence: float) -> str:
        """Why the view is spatially and semantically new; empty if it is not."""
        # Without labels the divergence is nan, and the overlap alone decides.
        same_classes = divergence <= self._min_divergence
        if overlap >= _MIN_OVERLAP or same_classes:
            return ""
        return f"overlap {overlap:.2f} and divergence {divergence:.2f}"

    def _far_from_anchor(self, keyframes: list[Keyframe]) -> str:
        T = se3.inverse(keyframes[0].T_map_camera) @ keyframes[-1].T_map_camera
        moved_m = float(np.linalg.norm(T[:3, 3]))
        turned_deg = float(np.degrees(se3.rotation_angle_rad(T[:3, :3])))
        if moved_m <= _MOVED_M and turned_deg <= _TURNED_DEG:
            return ""
        return f"{moved_m:.2f} m and {turned_deg:.0f} degrees from the anchor"

    def _divergence(self, newest: Keyframe, anchor: Keyframe) -> float:
        if not self._num_classes or newest.class_ids is None or anchor.class_ids is None:
            return float("nan")
        current, first = (
            class_histogram(k.class_ids.numpy(), self._num_classes)  # type: ignore[union-attr]
            for k in (newest, anchor)
        )
        return smoothed_kl(current, first)


def path_length_m(keyframes: list[Keyframe]) -> float:
    """Length of the path that led to new places, in metres.

    Each keyframe adds its distance from the nearest earlier one, so that going back adds nothing.
    """
    positions: NDArray[np.float64] = np.array([k.T_map_camera[:3, 3] for k in keyframes])
    apart_m = np.linalg.norm(positions[:, None] - positions, axis=2)
    apart_m[np.triu_indices(len(keyframes))] = np.inf
    return float(apart_m[1:].min(axis=1, initial=np.inf).sum())
