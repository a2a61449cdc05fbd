"""Quality of a registration: agreement of geometry and classes in rendered views.

Both maps are rendered from the same pose. A source surface behind that of the target is therefore
counted as a disagreement, not as an occlusion: the source's camera looked through a surface of the
target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration.views import SubmapView, ViewRenderer, views_of_overlap
from toolkit.slam.submaps.submap import Submap

Array = NDArray[np.float64]

# Maximum difference in depth of surfaces that agree, as a fraction of depth.
MAX_DISTANCE = 0.05
_MIN_DEPTH_M = 0.05


@dataclass(frozen=True)
class AlignmentCheck:
    """Pixel counts over views of the source, summed with `+`.

    Attributes:
        pixels: number of source pixels with a surface.
        overlapping: number of these that project onto a surface of the target.
        agreeing: number of overlapping pixels whose depths agree.
        labelled: number of agreeing pixels with a class in both maps.
        same_class: number of labelled pixels with the same class.
        views: number of views.
    """

    pixels: int = 0
    overlapping: int = 0
    agreeing: int = 0
    labelled: int = 0
    same_class: int = 0
    views: int = 0

    def __add__(self, other: AlignmentCheck) -> AlignmentCheck:
        counts, others = vars(self), vars(other)
        return AlignmentCheck(**{name: counts[name] + others[name] for name in counts})

    @property
    def overlap(self) -> float:
        """Fraction of the source's pixels that overlap with the target."""
        return self.overlapping / max(self.pixels, 1)

    @property
    def inliers(self) -> float:
        """Fraction of the overlapping pixels whose depths agree."""
        return self.agreeing / max(self.overlapping, 1)

    @property
    def class_agreement(self) -> float:
        """Fraction of the labelled pixels with the same class; nan without labels."""
        return self.same_class / self.labelled if self.labelled else float("nan")


def check_alignment(
    target: Submap,
    source: Submap,
    T_target_source: Array,
    renderer: ViewRenderer,
    views: Sequence[int] | int = 5,
) -> AlignmentCheck:
    """Compare renderings of two submaps from the poses of source keyframes.

    Args:
        renderer: renders the submaps.
        views: indices of the source keyframes, or the number of keyframes: those with the largest
            overlap with a target keyframe are chosen.
    """
    if isinstance(views, int):
        views = views_of_overlap(target, source, T_target_source, views)
    total = AlignmentCheck()
    for index in views:
        keyframe = source.keyframes[index]
        camera = renderer.camera_of(keyframe)
        source_view = renderer.render(source, camera, keyframe.T_map_camera)
        T_target_camera = T_target_source @ keyframe.T_map_camera
        total += compare(renderer.render(target, camera, T_target_camera), source_view)
    return total


def compare(
    target: SubmapView, source: SubmapView, T_view_frame: Array | None = None
) -> AlignmentCheck:
    """Compare a view of the source with a view of the target; their cameras may differ.

    Args:
        T_view_frame: [4, 4] pose of the source's camera in the target's view; identity by default.
    """
    depth = source.depth_m
    solid = depth > 0
    pixels = int(solid.sum())
    T = np.eye(4) if T_view_frame is None else T_view_frame
    points = se3.transform_points(T, source.camera.unproject(depth)[solid])
    ahead = points[:, 2] > _MIN_DEPTH_M
    pixel = np.rint(target.camera.project(np.where(ahead[:, None], points, [0, 0, 1]))).astype(int)
    inside = ahead & (pixel >= 0).all(axis=1) & (pixel < target.camera.size).all(axis=1)
    x, y = pixel[inside].T
    target_depth_m = target.depth_m[y, x]
    both = target_depth_m > 0
    difference = points[inside, 2][both] - target_depth_m[both]
    agree = np.abs(difference) < MAX_DISTANCE * target_depth_m[both]
    labelled, same = _class_counts(target, source, (solid, inside, both, agree), (x, y))
    return AlignmentCheck(
        pixels=pixels,
        overlapping=int(both.sum()),
        agreeing=int(agree.sum()),
        labelled=labelled,
        same_class=same,
        views=1,
    )


def _class_counts(
    target: SubmapView,
    source: SubmapView,
    masks: tuple[NDArray[np.bool_], ...],
    pixel: tuple[NDArray[np.integer], NDArray[np.integer]],
) -> tuple[int, int]:
    """Number of agreeing pixels with a class in both views, and of those with the same class."""
    if target.class_ids is None or source.class_ids is None:
        return 0, 0
    solid, inside, both, agree = masks
    x, y = pixel
    target_ids = target.class_ids[y, x][both][agree]
    source_ids = source.class_ids[solid][inside][both][agree]
    labelled = (target_ids > 0) & (source_ids > 0)
    return int(labelled.sum()), int((target_ids == source_ids)[labelled].sum())
