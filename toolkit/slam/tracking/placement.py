"""Keyframe placement: refines the pose of a new keyframe against the images of earlier keyframes.

The tracker aligns frames to the map, and images do not contain the map's errors: its surfaces
consist of overlapping Gaussians, and recent observations are not fitted yet. Therefore a new
keyframe is aligned once more, jointly to the images and depth of several earlier keyframes,
starting at the tracker's pose. In a synthetic room with sensor noise, paths through one submap
became five to ten times as accurate.

If the tracked pose has jumped relative to the recent keyframes, the motion since these counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import LruCache
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe, evenly_spaced, fractions_observed
from toolkit.slam.tracking.evidence import is_clear, quality
from toolkit.slam.tracking.options import PlacementOptions
from toolkit.slam.tracking.view_dependence import AlignedView, view_dependent, without_gradient
from toolkit.splatting.alignment.data import FrameLevel, ModelLevel
from toolkit.splatting.alignment.determinacy import UNITS
from toolkit.splatting.alignment.joint import Estimate, JointOptions, Pair, align
from toolkit.splatting.alignment.levels import (
    keyframe_level,
    limited_to_width,
    model_level,
    pyramid,
)
from toolkit.splatting.alignment.matching import correction_too_large
from toolkit.splatting.alignment.similarity import Similarity, aligned_correlation

Array = NDArray[np.float64]

# Numbers of newest and of older keyframes that a new one is aligned to.
_RECENT, _OLDER = 2, 4
# Of the older keyframes, every n-th is eligible. The set changes slowly, which reduces drift.
_EVERY = 4
# Minimum overlap of the new keyframe with a recent and with an older one.
_MIN_RECENT, _MIN_OLDER = 0.2, 0.5
# Quality relative to that of the tracked pose, and distance from it in units of 5 cm or 2 degrees,
# from which recent keyframes alone decide. Nearer poses are drift of the recent ones as often as
# errors of the tracked pose, unless the features are nearer to them by this factor.
_MUCH_BETTER, _JUMP, _NEARER = 1.5, 1.0, 0.5
# Tracked poses are accurate to one or two pixels, so few levels suffice. With half of these limits,
# alignment takes a quarter longer, and trajectories and maps are the same.
_DENSE = JointOptions(levels=2, small_translation_m=2e-4, small_rotation_rad=1e-4)

# Number of cached pyramids: computing one takes as long as aligning it.
_CACHED = 12


@dataclass(frozen=True, eq=False)
class _Levels:
    """A keyframe's pyramid, as the frame and, when it is first needed, as the model."""

    frame: list[FrameLevel]

    @cached_property
    def model(self) -> list[ModelLevel]:
        """The pyramid as the model of an alignment."""
        return [model_level(level) for level in self.frame]


class KeyframePlacement:
    """Refines the poses of new keyframes; caches the pyramids of the keyframes compared last."""

    def __init__(self, options: PlacementOptions | None = None) -> None:
        self.options = options or PlacementOptions()
        self._cache: LruCache[_Levels] = LruCache(_CACHED)

    def place(
        self, keyframes: Sequence[Keyframe], new: Keyframe, T_by_features: Array | None = None
    ) -> Array:
        """Refine the pose of a new keyframe.

        Args:
            keyframes: keyframes of the same map, in order; their poses do not change.
            new: the new keyframe, at the tracker's pose.
            T_by_features: T_map_camera [4, 4] by features that were followed from recent keyframes.

        Returns:
            T_map_camera [4, 4]; the tracker's pose if the alignment fails or moves it too far
            without evidence.
        """
        older, recent = self._chosen(keyframes, new)
        if not older and not recent:
            return new.T_map_camera
        found = self._aligned(older + recent, new, new.T_map_camera)
        moved = se3.inverse(new.T_map_camera) @ found.T_target_source
        if found.converged and not correction_too_large(np.eye(4), moved, new.camera, new):
            return found.T_target_source
        if not recent:
            return new.T_map_camera
        # After drift, the map and older keyframes contradict the recent ones, and the tracked pose
        # jumps. The motion since the recent ones is what the images show; loop closure distributes
        # the drift.
        enough = _MUCH_BETTER * quality(self._similarity(recent[-1], new, new.T_map_camera))
        for start in (new.T_map_camera, T_by_features):
            if start is None:
                continue
            # Without older ones, the first alignment was to the recent ones alone.
            if older or start is T_by_features:
                found = self._aligned(recent, new, start)
            T_map_camera = found.T_target_source
            similarity = self._similarity(recent[-1], new, T_map_camera)
            better = is_clear(similarity, _MIN_RECENT) and quality(similarity) > enough
            jump = _distance(new.T_map_camera, T_map_camera)
            agrees = (
                T_by_features is not None
                and _distance(T_by_features, T_map_camera) < _NEARER * jump
            )
            if better and (agrees or jump > _JUMP):
                return T_map_camera
        return new.T_map_camera

    def _aligned(self, chosen: Sequence[Keyframe], new: Keyframe, start: Array) -> Estimate:
        """The pose relative to some keyframes, from an initial T_map_camera [4, 4]."""
        frame, models = self._levels(new).frame, self._models(chosen, new)
        pairs = [
            Pair(model, frame, se3.inverse(k.T_map_camera), np.eye(4))
            for k, model in zip(chosen, models, strict=True)
        ]
        return align(pairs, Estimate(start), _DENSE)

    def _similarity(self, earlier: Keyframe, new: Keyframe, T_map_camera: Array) -> Similarity:
        """That of the images of two keyframes at a pose [4, 4] of the new one."""
        model, frame = self._levels(earlier).model[0], self._levels(new).frame[0]
        return aligned_correlation(model, frame, se3.inverse(earlier.T_map_camera) @ T_map_camera)

    def _chosen(
        self, keyframes: Sequence[Keyframe], new: Keyframe
    ) -> tuple[list[Keyframe], list[Keyframe]]:
        """Older and recent keyframes that overlap with the new one, in order."""
        points = new.points_in_map()
        first_recent = max(len(keyframes) - _RECENT, 0)
        recent = _observing(keyframes[first_recent:], points, _MIN_RECENT)
        older = _observing(keyframes[:first_recent:_EVERY], points, _MIN_OLDER)
        return evenly_spaced(older, _OLDER), recent

    def _models(self, chosen: Sequence[Keyframe], new: Keyframe) -> list[list[ModelLevel]]:
        """Pyramids of earlier keyframes; view-dependent surfaces may lack texture."""
        models = [self._levels(k).model for k in chosen]
        if not self.options.ignore_reflections:
            return models
        masks = view_dependent(self._coarse_view(new), [self._coarse_view(k) for k in chosen])
        return [
            model if mask is None else [without_gradient(level, mask) for level in model]
            for model, mask in zip(models, masks, strict=True)
        ]

    def _coarse_view(self, keyframe: Keyframe) -> AlignedView:
        return AlignedView(keyframe.T_map_camera, self._levels(keyframe).frame[-1])

    def _levels(self, keyframe: Keyframe) -> _Levels:
        key = (keyframe.index, keyframe.exposure)
        return self._cache.get(key, lambda: self._new_levels(keyframe))

    def _new_levels(self, keyframe: Keyframe) -> _Levels:
        finest = limited_to_width(keyframe_level(keyframe), self.options.max_width)
        return _Levels(pyramid(finest, _DENSE.levels))


def _distance(T_first: Array, T_second: Array) -> float:
    """Distance of two poses [4, 4]."""
    motion = se3.log(se3.inverse(T_first) @ T_second) / UNITS
    return max(float(np.linalg.norm(part)) for part in (motion[:3], motion[3:]))


def _observing(
    keyframes: Sequence[Keyframe], points_map: Array, min_fraction: float
) -> list[Keyframe]:
    """The keyframes that measured at least a fraction of the points [P, 3]."""
    fractions = fractions_observed(keyframes, points_map)
    return [k for k, f in zip(keyframes, fractions, strict=True) if f >= min_fraction]
