"""Quality of a registration: agreement of geometry and classes in rendered views.

Both views are rendered from the same side. A source surface behind the target's is therefore no
occlusion but a contradiction: the source's camera saw through a surface of the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.geometry import se3
from toolkit.registration.views import View, ViewRenderer, views_of_overlap
from toolkit.submaps.submap import Submap

Array = NDArray[np.float64]

# Surfaces agree when their depths differ by less than this share.
MAX_DISTANCE = 0.05
_NEAREST_M = 0.05


@dataclass(frozen=True)
class AlignmentCheck:
    """Counts over the pixels of some views of the source, added up with `+`.

    Attributes:
        pixels: source pixels with a surface.
        overlapping: those that fall on a surface of the target.
        agreeing: those whose depth it shares.
        squares_m2: sum of the squared depth differences of the agreeing ones.
        labelled: agreeing ones with a class on both sides.
        same_class: those with the same class.
        views: views compared.
    """

    pixels: int = 0
    overlapping: int = 0
    agreeing: int = 0
    squares_m2: float = 0.0
    labelled: int = 0
    same_class: int = 0
    views: int = 0

    def __add__(self, other: AlignmentCheck) -> AlignmentCheck:
        mine, others = vars(self), vars(other)
        return AlignmentCheck(**{name: mine[name] + others[name] for name in mine})

    @property
    def overlap(self) -> float:
        """Share of the source's pixels that the target shows as well."""
        return self.overlapping / max(self.pixels, 1)

    @property
    def inliers(self) -> float:
        """Share of the overlapping pixels whose surfaces agree."""
        return self.agreeing / max(self.overlapping, 1)

    @property
    def fitness(self) -> float:
        """Share of the source's pixels that lie on the target's surface (as in Open3D)."""
        return self.agreeing / max(self.pixels, 1)

    @property
    def rmse_m(self) -> float:
        """Root mean square depth difference of the agreeing pixels, nan where there are none."""
        return float(np.sqrt(self.squares_m2 / self.agreeing)) if self.agreeing else float("nan")

    @property
    def class_agreement(self) -> float:
        """Share of the agreeing, labelled pixels of the same class, nan without labels."""
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
        views: indices of the source keyframes, or how many to choose: those with the largest
            overlap with a target keyframe.
    """
    if isinstance(views, int):
        views = views_of_overlap(target, source, T_target_source, views)
    total = AlignmentCheck()
    for place in views:
        keyframe = source.keyframes[place]
        camera = renderer.camera_of(keyframe)
        seen = renderer.render(source, camera, keyframe.T_map_camera)
        T_target_camera = T_target_source @ keyframe.T_map_camera
        total += compare(renderer.render(target, camera, T_target_camera), seen)
    return total


def compare(target: View, source: View, T_view_frame: Array | None = None) -> AlignmentCheck:
    """Compare one view of the source with one of the target; their cameras may differ.

    Args:
        T_view_frame: [4, 4] pose of the source's camera in the target's view; identity by default.
    """
    depth = source.depth_m
    solid = depth > 0
    pixels = int(solid.sum())
    T = np.eye(4) if T_view_frame is None else T_view_frame
    points = se3.transform_points(T, source.camera.unproject(depth)[solid])
    ahead = points[:, 2] > _NEAREST_M
    place = np.rint(target.camera.project(np.where(ahead[:, None], points, [0, 0, 1]))).astype(int)
    inside = ahead & (place >= 0).all(axis=1) & (place < target.camera.size).all(axis=1)
    x, y = place[inside].T
    drawn = target.depth_m[y, x]
    both = drawn > 0
    difference = points[inside, 2][both] - drawn[both]
    agree = np.abs(difference) < MAX_DISTANCE * drawn[both]
    labelled, same = _classes(target, source, (solid, inside, both, agree), (x, y))
    return AlignmentCheck(
        pixels=pixels,
        overlapping=int(both.sum()),
        agreeing=int(agree.sum()),
        squares_m2=float((difference[agree].astype(np.float64) ** 2).sum()),
        labelled=labelled,
        same_class=same,
        views=1,
    )


def _classes(
    target: View,
    source: View,
    masks: tuple[NDArray[np.bool_], ...],
    place: tuple[NDArray[np.integer], NDArray[np.integer]],
) -> tuple[int, int]:
    """Agreeing pixels with a class on both sides, and those of one class."""
    if target.class_ids is None or source.class_ids is None:
        return 0, 0
    solid, inside, both, agree = masks
    x, y = place
    shown = target.class_ids[y, x][both][agree]
    own = source.class_ids[solid][inside][both][agree]
    labelled = (shown > 0) & (own > 0)
    return int(labelled.sum()), int((shown == own)[labelled].sum())
