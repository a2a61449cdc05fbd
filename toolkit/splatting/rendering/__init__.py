"""Gaussian splat rendering with interchangeable backends."""

from toolkit.base.native.constants import TILE
from toolkit.splatting.rendering.backend import GaussianGradients, pixels_of_region, tile_counts
from toolkit.splatting.rendering.output import RenderOutput
from toolkit.splatting.rendering.render import backend, map_device, render
from toolkit.splatting.rendering.surface import RenderOptions, SurfaceView, render_surface

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
