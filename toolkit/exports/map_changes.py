"""Compare the objects of two finished runs of one place."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import SettingsError
from toolkit.base.geometry import se3
from toolkit.exports.mapped_scene import MappedScene
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.visibility import KeyframeViews
from toolkit.scene.graph.changes import MapChanges, Seen, compare_objects
from toolkit.scene.query import SceneObject


def changes_between(
    before: MappedScene, after: MappedScene, T_before_after: NDArray[np.float64]
) -> MapChanges:
    """Compare the objects of two maps; what encloses rooms is not compared.

    Args:
        before: the first map; changes are in its frame.
        after: the second map.
        T_before_after: [4, 4] pose of the second map in the frame of the first.

    Raises:
        SettingsError: a map has no known unit of length, so that places and sizes do not compare.
    """
    require_metres(before.selection.run, after.selection.run)
    T_after_before = se3.inverse(T_before_after)
    return compare_objects(
        _objects(before, np.eye(4)),
        _objects(after, T_before_after),
        lambda points_m: _seen(before.views, points_m),
        lambda points_m: _seen(after.views, se3.transform_points(T_after_before, points_m)),
    )


def require_metres(*runs: FinishedRun) -> None:
    """Check that places and sizes in the maps of runs can be compared.

    Raises:
        SettingsError: a map has no known unit of length.
    """
    for run in runs:
        if not run.metric:
            raise SettingsError(
                f"run {run.folder.path.resolve().name} has lengths in arbitrary units, so its "
                "objects cannot be compared; run SLAM again with --scale"
            )


def _objects(scene: MappedScene, T: NDArray[np.float64]) -> list[SceneObject]:
    """Return the objects that are in rooms, moved by a rigid motion [4, 4]."""
    return [one.moved(T) for one in scene.objects if not scene.enclosing[one.number]]


def _seen(views: KeyframeViews, points_m: NDArray[np.float64]) -> Seen:
    surface = np.zeros(len(points_m), int)
    through = np.zeros(len(points_m), int)
    for view in range(len(views)):
        sight = views.sight(view, points_m)
        surface += sight.surface
        through += sight.through
    observed = surface + through > 0
    return Seen(float(observed.mean()), float((through > surface).mean()))
