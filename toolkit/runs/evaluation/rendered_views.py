"""Views of the map as the camera would take them at the poses of frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY, NEUTRAL, Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.slam.tracking.rolling_shutter import as_exposed, rectified
from toolkit.splatting.gaussians.scene import GaussianScene
from toolkit.splatting.rendering import RenderOptions, SurfaceView, backend, render_surface

Image = NDArray[np.float32]

# Minimum silhouette (0-1) of rendered pixels whose depth is evaluated.
MIN_SILHOUETTE = 0.5


@dataclass(frozen=True)
class EvaluatedView:
    """A frame, its pose, and its exposure against the map.

    Attributes:
        velocity: [6] m/s and rad/s of the camera in its own frame; None if it is not known.
    """

    frame: Frame
    T_map_camera: NDArray[np.float64]
    exposure: Exposure = IDENTITY
    velocity: NDArray[np.float64] | None = None

    def rectified(self) -> Frame:
        """The frame without the effect of its rolling shutter."""
        return rectified(self.frame, self.velocity)


@dataclass(frozen=True, eq=False)
class RenderedView:
    """The map at the pose of a frame.

    Attributes:
        view: the frame.
        surface: what was rendered.
        colour: [H, W, 3] with the exposure, white balance and rolling shutter of the frame.
        one_gain: the same without the white balance that the run estimated for the frame.
        depth_m: [H, W] with its rolling shutter; 0 where no surface was rendered.
    """

    view: EvaluatedView
    surface: SurfaceView
    colour: Image
    one_gain: Image
    depth_m: Image


def render_view(
    scene: GaussianScene, view: EvaluatedView, backend_name: str, features: bool, scale: float
) -> RenderedView:
    """Render a map at the pose of a frame.

    Args:
        scene: the map.
        view: the frame.
        backend_name: the renderer.
        features: whether features are rendered, too.
        scale: metres per unit of length of the map.
    """
    camera, T_camera_map = view.frame.camera, se3.inverse(view.T_map_camera)
    gaussians = scene.visible_from(camera, view.T_map_camera)
    options = RenderOptions(MIN_SILHOUETTE, features=features)
    surface = render_surface(backend(backend_name), gaussians, camera, T_camera_map, options)
    # Apply the exposure to the rendered image, so that the observed image is not changed.
    reference, exposure = surface.output.colour.numpy(), view.exposure
    colour, one_gain = (
        one.undo(reference).clip(0.0, 1.0).astype(np.float32)
        for one in (exposure, exposure.with_balance(NEUTRAL))
    )
    depth_m = np.float32(scale) * surface.depth_m.numpy()
    # The sensor's images are not changed: the rendering is exposed like them.
    (colour, depth_m), (one_gain, _) = (
        as_exposed(image, depth_m, view.frame, view.velocity) for image in (colour, one_gain)
    )
    return RenderedView(view, surface, colour, one_gain, depth_m)
