"""The scene graph of a run: it grows with every keyframe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

from numpy.typing import NDArray

from toolkit.base.frame import Recorder
from toolkit.base.stages import Stage
from toolkit.scene.growing.growing import GrowingScene
from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.result import SlamResult
from toolkit.slam.submaps.atlas import Atlas


class SceneListener:
    """Tells a scene about the keyframes of a run; see `MapListener`."""

    name = "scene"

    def __init__(self, scene: GrowingScene, recorder: Recorder) -> None:
        self.scene, self._recorder = scene, recorder
        self._ended = False

    def frame_added(self, atlas: Atlas, metres_per_unit: float) -> None:
        """Extend objects and relations by new keyframes."""
        with self._recorder.timed(Stage.SCENE_GRAPH):
            self.scene.update(atlas, metres_per_unit)

    def corrected(self, atlas: Atlas, metres_per_unit: float) -> None:
        """Compare all objects at their final places."""
        self.scene.finish(atlas, metres_per_unit)

    def finished(self, _atlas: Atlas, maps: Sequence[FusedMap | None]) -> None:
        """The graph is complete."""
        self._ended = bool(maps)

    def content(self) -> dict[str, Any] | None:
        """The graph in node-link format; None before the end, and without a floor."""
        return self.scene.content() if self._ended else None

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """That of the scene."""
        return self.scene.state()

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self.scene.restore(arrays, values)


def scene_graph_of(result: SlamResult) -> dict[str, Any] | None:
    """The graph that grew with the map, in node-link format; None without one."""
    return cast("dict[str, Any] | None", result.heard.get(SceneListener.name))
