"""The scene graph of a run: it grows with every keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from numpy.typing import NDArray

from toolkit.base.frame import Recorder
from toolkit.base.stages import Stage
from toolkit.io.arrays import arrays_below
from toolkit.scene.growing.growing import GrowingScene
from toolkit.scene.growing.snapshot import Snapshot
from toolkit.scene.instances.geometric import GeometricMasks
from toolkit.scene.instances.options import InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import SlamResult
from toolkit.slam.submaps.atlas import Atlas


class SceneListener:
    """Tells a scene about the keyframes of a run; see `MapListener`.

    Args:
        taxonomy: classes of the labels.
        tracker: follows the objects of the run, told of them before; None to follow connected
            surfaces of one class.
        recorder: measures the time.

    Attributes:
        scene: what is known so far.
    """

    name = "scene"

    def __init__(
        self, taxonomy: Taxonomy, tracker: InstanceTracker | None, recorder: Recorder
    ) -> None:
        names = dict(enumerate(taxonomy.classes, start=1))
        masks = GeometricMasks("required")
        surfaces = InstanceTracker(InstanceOptions(), masks, names, connected=True)
        self._own = surfaces if tracker is None else None
        self.scene = GrowingScene(taxonomy, tracker or surfaces, connected=tracker is None)
        self._recorder = recorder
        self._ended = False

    def frame_added(self, atlas: Atlas, metres_per_unit: float) -> None:
        """Extend objects and relations by new keyframes."""
        with self._recorder.timed(Stage.SCENE_GRAPH):
            if self._own is not None:
                self._own.update(atlas.active, atlas.keyframes)
            self.scene.update(atlas, metres_per_unit)

    def finished(
        self, atlas: Atlas, metres_per_unit: float, _maps: Sequence[FusedMap | None]
    ) -> None:
        """Compare all objects at their final places; the tracker has joined its objects."""
        self.scene.finish(atlas, metres_per_unit)
        self._ended = True

    def content(self) -> dict[str, Any] | None:
        """The graph in node-link format; None before the end, and without a floor."""
        return self.scene.content() if self._ended else None

    def snapshot(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """What `read_snapshot` reads."""
        snapshot = self.scene.snapshot()
        return ({}, {}) if snapshot is None else snapshot.state()

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """That of the scene and of its own tracker, with a snapshot for viewers."""
        arrays, values = self.scene.state()
        parts = {"shown": self.snapshot()}
        if self._own is not None:
            parts["tracker"] = self._own.state()
        for name, (own, described) in parts.items():
            arrays |= {f"{name}/{key}": array for key, array in own.items()}
            values[name] = described
        return arrays, values

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        if self._own is not None:
            self._own.restore(arrays_below(arrays, "tracker/"), values["tracker"])
        self.scene.restore(arrays, values)


def read_snapshot(arrays: dict[str, NDArray], values: dict[str, Any]) -> Snapshot | None:
    """Read the scene of a checkpoint or snapshot of a run; None before its floor is known."""
    shown = values["shown"]
    return Snapshot.from_state(arrays_below(arrays, "shown/"), shown) if shown else None


def scene_graph_of(result: SlamResult) -> dict[str, Any] | None:
    """The graph that grew with the map, in node-link format; None without one."""
    return cast("dict[str, Any] | None", result.heard.get(SceneListener.name))
