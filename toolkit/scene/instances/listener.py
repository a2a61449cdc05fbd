"""Objects of a run: followed with every keyframe, and given to the Gaussians at the end."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from numpy.typing import NDArray

from toolkit.base.frame import Recorder
from toolkit.base.stages import Stage
from toolkit.scene.instances.finishing import finish_instances
from toolkit.scene.instances.result import InstanceMap
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import SlamResult
from toolkit.slam.submaps.atlas import Atlas


class InstanceListener:
    """Tells a tracker of objects about the keyframes of a run; see `MapListener`."""

    name = "instances"

    def __init__(self, tracker: InstanceTracker, recorder: Recorder) -> None:
        self.tracker, self._recorder = tracker, recorder
        self._found: InstanceMap | None = None

    def frame_added(self, atlas: Atlas, _metres_per_unit: float) -> None:
        """Associate the masks of new keyframes."""
        with self._recorder.timed(Stage.INSTANCES):
            self.tracker.update(atlas.active, atlas.keyframes)

    def finished(
        self, atlas: Atlas, _metres_per_unit: float, maps: Sequence[FusedMap | None]
    ) -> None:
        """Give every Gaussian its object."""
        if not self.tracker.is_idle:
            with self._recorder.timed(Stage.INSTANCE_VOTES):
                self._found = finish_instances(self.tracker, atlas, maps)

    def content(self) -> InstanceMap | None:
        """The objects of the map; None before its end."""
        return self._found

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """That of the tracker."""
        return self.tracker.state()

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self.tracker.restore(arrays, values)


def instances_of(result: SlamResult) -> InstanceMap | None:
    """The objects of a finished map; None for a run without instances."""
    return cast("InstanceMap | None", result.heard.get(InstanceListener.name))
