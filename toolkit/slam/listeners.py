"""Who is told how the map grows: objects and scene graphs, on which no pose depends."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from numpy.typing import NDArray

from toolkit.slam.refinement.fusion import FusedMap
from toolkit.slam.submaps.atlas import Atlas


class MapListener(Protocol):
    """Follows the keyframes of a run; it changes neither poses nor the map.

    Attributes:
        name: of its state in checkpoints, and of its content in results.
    """

    name: str

    def frame_added(self, atlas: Atlas, metres_per_unit: float) -> None:
        """A frame has a pose, and its keyframe is mapped if it became one.

        Args:
            metres_per_unit: length of the unit of the atlas.
        """

    def finished(
        self, atlas: Atlas, metres_per_unit: float, maps: Sequence[FusedMap | None]
    ) -> None:
        """All poses are final, and the maps of all parts fused; None where one is not readable."""

    def content(self) -> Any:
        """What it has found, for `SlamResult.heard`; None before the end."""

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues to identical results."""

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
