"""Pictures of a finished map in which some Gaussians are highlighted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.thinning import thinned
from toolkit.io.visualisation import RgbImage, colour_image
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.visibility import keyframe_views
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import RenderOptions, backend, render_surface

Array = NDArray[np.float64]

# The rest of the map is grey and darker, the selection keeps this share of its own colour.
_HIGHLIGHT, _OWN_SHARE, _GREY_SHARE = (1.0, 0.55, 0.05), 0.35, 0.65
_LUMINANCE = (0.299, 0.587, 0.114)
# Number of points of the selection by which views are compared.
_SAMPLES = 2000
_MIN_HEIGHT = 480
_EDGE, _INK = (255, 120, 0), (20, 24, 30)


@dataclass(frozen=True)
class Marker:
    """A short text at a place of the map.

    Attributes:
        text: the text, shown as it is.
        place_m: [3] in the map.
    """

    text: str
    place_m: Array


def highlighted_view(
    run: FinishedRun, selected: NDArray[np.bool_], markers: Sequence[Marker] = ()
) -> RgbImage:
    """Render the keyframe that shows most of the selected Gaussians.

    Args:
        run: the run.
        selected: [N] mask of its Gaussians, at least one.
        markers: texts to write at places that the view shows.
    """
    T_map_camera = _best_pose(run, selected)
    T_camera_map = se3.inverse(T_map_camera)
    factor = max(1, -(-_MIN_HEIGHT // run.camera.height))
    camera = run.camera.scaled(
        factor, factor, run.camera.width * factor, run.camera.height * factor
    )
    render = backend(run.settings.backend)
    options = RenderOptions()
    painted = _painted(run.gaussians, selected)
    view = render_surface(render, painted, camera, T_camera_map, options)
    image = colour_image(view.output.colour.numpy())
    # The same map in black, with the selection in white.
    white = torch.from_numpy(selected.astype(np.float32))[:, None].expand(-1, 3)
    flat = replace(painted, colours=white.contiguous())
    share = render_surface(render, flat, camera, T_camera_map, options).output.colour.numpy()
    mask = (np.asarray(share).mean(axis=-1) > 0.5).astype(np.uint8)
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    image = np.ascontiguousarray(image)
    cv2.drawContours(image, outlines, -1, _EDGE, 2, cv2.LINE_AA)
    for marker in markers:
        local = se3.transform_points(T_camera_map, marker.place_m[None])
        if local[0, 2] > 0:
            _write(image, marker.text, camera.project(local)[0])
    return image


def _best_pose(run: FinishedRun, selected: NDArray[np.bool_]) -> Array:
    """T_map_camera [4, 4] of the keyframe that sees most of the selection."""
    views = keyframe_views(run)
    means = run.gaussians.means.double().numpy()[selected]
    sample = thinned(means, _SAMPLES)
    seen = [int(views.sight(k, sample).surface.sum()) for k in range(len(views))]
    return np.asarray(views.T_map_camera[int(np.argmax(seen))])


def _painted(gaussians: GaussianCloud, selected: NDArray[np.bool_]) -> GaussianCloud:
    """Gaussians of which the selected ones are orange, and the others grey."""
    own = gaussians.colours.clamp(0.0, 1.0)
    grey = (own @ own.new_tensor(_LUMINANCE))[:, None].expand(-1, 3) * _GREY_SHARE
    orange = _OWN_SHARE * own + (1.0 - _OWN_SHARE) * own.new_tensor(_HIGHLIGHT)
    colours = torch.where(torch.from_numpy(selected)[:, None], orange, grey)
    shapes = None if gaussians.ellipsoids is None else gaussians.ellipsoids.with_degree(0)
    return replace(gaussians, colours=colours, ellipsoids=shapes)


def _write(image: RgbImage, text: str, place: Array) -> None:
    """Write a text centred at a pixel (x, y); nothing outside of the image."""
    height, width = image.shape[:2]
    if not (0 <= place[0] < width and 0 <= place[1] < height):
        return
    font = cv2.FONT_HERSHEY_SIMPLEX
    (wide, high), _ = cv2.getTextSize(text, font, 0.6, 2)
    origin = (int(place[0] - wide / 2), int(place[1] + high / 2))
    for colour, thickness in ((_INK, 5), ((255, 255, 255), 1)):
        cv2.putText(image, text, origin, font, 0.6, colour, thickness, cv2.LINE_AA)
