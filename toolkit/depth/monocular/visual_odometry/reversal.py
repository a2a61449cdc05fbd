"""Structure turned inside out: the mirror image of a motion that fits nearly as well (Necker).

A camera that turns sees its landmarks for a few images only, with little parallax. Relief and
motion across it can then change their sign together, which a rotation compensates. Bundle
adjustment does not leave the wrong one of the two minima by itself; the scale shrinks from view
to view until landmarks with more parallax appear.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.depth.monocular.bundle_adjustment.problem import BundleOptions
from toolkit.depth.monocular.visual_odometry.landmarks import OdometryView
from toolkit.depth.monocular.visual_odometry.sparse_map import SparseMap
from toolkit.depth.monocular.visual_odometry.two_view import fit_rotation

Array = NDArray[np.float64]

# Numbers of newest views that are mirrored together.
_REVERSED = (3, 5, 7)
# Landmarks from before them hold their structure if they are a larger fraction of those of the
# newest view; so do views that have turned less, whose landmarks stay in view.
_MAX_OLDER = 0.4
_MIN_TURN_RAD = np.radians(20.0)
_MIN_SHARED = 15
# The mirror image counts if its cost is below this fraction. Where structure was reversed in the
# HoloLens walk and in walks through rooms, it is 0.83 to 0.9. Elsewhere most mirror images return
# to the same minimum, and others have 0.93 or more; taken, those make walks worse.
_MAX_COST_RATIO = 0.9
# Few iterations show whether the mirror image may come that far.
_FIRST = BundleOptions(iterations=8)
_MAX_FIRST_RATIO = 1.5
_REST = BundleOptions(iterations=30)
# Smallest inverse depth of a mirrored landmark relative to the median in its anchor.
_MIN_INVERSE_DEPTH = 0.05


def without_reversal(sparse_map: SparseMap, window: range, free: range) -> SparseMap:
    """The map, or a copy in which the newest views are mirrored if that fits much better.

    Args:
        sparse_map: after bundle adjustment.
        window, free: views of that bundle adjustment, see `SparseMap.adjust`.
    """
    pivots = _pivots(sparse_map)
    if not pivots:
        return sparse_map
    mirrored = [other for pivot in pivots if (other := _mirrored(sparse_map, pivot)) is not None]
    if not mirrored:
        return sparse_map
    cost = sparse_map.copy().adjust(window, free, BundleOptions(), clean=False).cost
    costs = [other.adjust(window, free, _FIRST, clean=False).cost for other in mirrored]
    best = mirrored[int(np.argmin(costs))]
    if min(costs) > _MAX_FIRST_RATIO * cost:
        return sparse_map
    found = best.adjust(window, free, _REST, clean=False)
    return best if found.cost < _MAX_COST_RATIO * cost else sparse_map


def _pivots(sparse_map: SparseMap) -> list[int]:
    """Views after which the structure may be reversed."""
    views, table = sparse_map.views, sparse_map.table
    newest = views[-1]
    ids = newest.features.ids
    anchors = table.anchor[ids[table.measured[ids]]]
    if not len(anchors):
        return []
    pivots = [len(views) - 1 - count for count in _REVERSED]
    return [
        pivot
        for pivot in pivots
        if pivot > 0
        and (anchors < pivot).mean() < _MAX_OLDER
        and se3.rotation_angle_rad(_relative(views[pivot], newest)[:3, :3]) > _MIN_TURN_RAD
    ]


def _mirrored(sparse_map: SparseMap, pivot: int) -> SparseMap | None:
    """A copy with mirrored motion and structure after a view; None without common features."""
    other = sparse_map.copy()
    before = sparse_map.views
    for number in range(pivot, len(before) - 1):
        first, second = before[number], before[number + 1]
        _, a, b = np.intersect1d(first.features.ids, second.features.ids, return_indices=True)
        if len(a) < _MIN_SHARED:
            return None
        px = first.features.px[a], second.features.px[b]
        R, _ = fit_rotation(sparse_map.camera, *px)
        step = se3.inverse(_relative(first, second))
        step = se3.from_rotation_translation(R @ step[:3, :3].T @ R, -step[:3, 3])
        T = other.views[number].T_world_camera @ se3.inverse(step)
        other.views[number + 1].T_world_camera = T
    _mirror_landmarks(other, pivot)
    return other


def _mirror_landmarks(sparse_map: SparseMap, pivot: int) -> None:
    """Mirror the inverse depths about their median in each view from the pivot on."""
    table = sparse_map.table
    ids = np.unique(np.concatenate([view.features.ids for view in sparse_map.views[pivot:]]))
    ids = ids[(table.anchor[ids] >= pivot) & (table.inverse_depth[ids] > 0)]
    for anchor in np.unique(table.anchor[ids]):
        own = ids[table.anchor[ids] == anchor]
        inverse_depth = table.inverse_depth[own]
        middle = float(np.median(inverse_depth))
        table.inverse_depth[own] = np.maximum(
            2.0 * middle - inverse_depth, _MIN_INVERSE_DEPTH * middle
        )


def _relative(first: OdometryView, second: OdometryView) -> Array:
    """T_first_second [4, 4]."""
    return se3.inverse(first.T_world_camera) @ second.T_world_camera
