"""Gaussian splat rendering with interchangeable backends."""

from toolkit.native.constants import TILE
from toolkit.rendering.backend import GaussianGradients, pixels_of_region, tile_counts
from toolkit.rendering.output import RenderOutput
from toolkit.rendering.render import backend, map_device, render
from toolkit.rendering.surface import DrawOptions, SurfaceView, draw_surface

__all__ = [
    "TILE",
    "DrawOptions",
    "GaussianGradients",
    "RenderOutput",
    "SurfaceView",
    "backend",
    "draw_surface",
    "map_device",
    "pixels_of_region",
    "render",
    "tile_counts",
]
