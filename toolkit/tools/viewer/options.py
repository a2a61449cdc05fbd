"""Options of the viewer."""

from __future__ import annotations

from dataclasses import dataclass

from toolkit.base.options import NonNegativeInt, PositiveInt


@dataclass(frozen=True)
class ShownContent:
    """What a viewer shows of a map."""

    max_gaussians: PositiveInt = 300_000
    """Maximum number of Gaussians that are shown, preferably those that look large from the cameras
    of the run. `semsplat view` streams larger maps instead."""
    images: NonNegativeInt = 60
    """Maximum number of keyframes that are shown with their image, evenly spaced."""
    image_width: PositiveInt = 240
    """Maximum width of keyframe images, in pixels."""
    graph: bool = False
    """Show the scene graph of a labelled map as a tree of storeys (if there are several), rooms and
    objects, whose entries mark the object in the view. Only in the page of `semsplat export`;
    `semsplat view` shows the graph of runs with --scene.graph."""
