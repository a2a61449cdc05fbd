"""Gaussian splat rendering with interchangeable backends."""

from toolkit.native.constants import TILE
from toolkit.rendering.backend import GaussianGradients, pixels_of_region, tile_counts
from toolkit.rendering.output import RenderOutput
from toolkit.rendering.render import backend, map_device, render
from toolkit.rendering.surface import RenderOptions, SurfaceView, render_surface

__all__ = [
    "TILE",
    "GaussianGradients",
    "RenderOptions",
    "RenderOutput",
    "SurfaceView",
    "backend",
    "map_device",
    "pixels_of_region",
    "render",
    "render_surface",
    "tile_counts",
]
