"""How well neighbouring images predict the view of a frame, beside how well the map does.

Optical flow carries a neighbouring image into the frame, whatever the motion, the intrinsics and
the scene are. The difference that remains comes from the images: noise, changes of exposure, blur,
reflections. A map of the right geometry averages many images, and is at least as close as that.
Images are reduced to a small width, at which the resolution of the map hardly matters.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.runs.evaluation.rendered_views import RenderedView

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Longer side of the compared images, in pixels, and the smallest shorter side that flow needs.
SIDE_PX, _MIN_SIDE_PX = 160, 16
# Flow there and back again must return this near, in pixels; it does not where a surface is hidden
# in the other image.
_MAX_RETURN_PX = 1.0
# Part of the image that must be known from a neighbour.
_MIN_KNOWN = 0.3
# Pixels of the map that are farther from those of the image, in pixels, are displaced.
_DISPLACED_PX = 1.0
# Points that are compared with a rigid motion, and rounds in which outliers lose their weight.
_MIN_POINTS, _ROUNDS = 100, 8
# Relative differences in depth count as at most this much: at edges, they say little.
_LARGEST = 0.1


@dataclass(frozen=True, eq=False)
class SmallView:
    """A frame and the map seen from there, reduced to a small size.

    Attributes:
        index: of the frame.
        camera: intrinsics of the small images.
        rgb: [H, W, 3] of the frame. depth_m: [H, W] measured, 0 where missing; None if the map does
            not follow from it.
        map_rgb: [H, W, 3] of the map, exposed as the frame.
        map_depth: [H, W] in units of the map, 0 where missing.
        compared: [H, W], False where the frame is ignored, and where the depth is missing that
            others have.
        source_size: (width, height) of the frame.
    """

    index: int
    camera: Camera
    rgb: Image
    depth_m: Image | None
    map_rgb: Image
    map_depth: Image
    compared: Mask
    source_size: tuple[int, int]

    @classmethod
    def of(cls, rendered: RenderedView, scale: float, uses_depth: bool) -> SmallView:
        """Reduce a frame and what the map shows at its pose.

        Args:
            scale: metres per unit of length of the map.
            uses_depth: whether the map follows from measured depth.
        """
        frame = rendered.view.frame
        small = _small_camera(frame.camera)
        depth_m = _nearest(frame.depth_m, small) if uses_depth else None
        compared = np.ones((small.height, small.width), bool)
        if frame.ignored is not None:
            compared &= _reduced(frame.ignored.astype(np.float32), small) == 0
        return cls(
            frame.index,
            small,
            _reduced(frame.rgb, small),
            depth_m,
            _reduced(rendered.colour, small),
            _nearest(rendered.depth_m, small) / np.float32(scale),
            compared if depth_m is None else compared & (depth_m > 0),
            frame.camera.size,
        )


@dataclass(frozen=True)
class ViewComparison:
    """Errors of the map and of neighbouring images, at the same pixels of one frame.

    Attributes:
        map_error, fitted_error, image_error: mean squared differences of colours in [0, 1], of the
            map, of the map after fitting a gain and a bias per channel, and of neighbours.
        offset_px: median distance between where the map and the image show the same.
        displaced: share of the pixels where it is more than one pixel.
        map_depth, image_depth: mean relative differences from measured depth, at most 0.1 a pixel,
            of the map, and of neighbours after a rigid motion; None without depth.
    """

    map_error: float
    fitted_error: float
    image_error: float
    offset_px: float
    displaced: float
    map_depth: float | None = None
    image_depth: float | None = None


def compare(view: SmallView, neighbours: Iterable[Frame]) -> ViewComparison | None:
    """Compare a view of the map with the images of neighbouring frames.

    Args:
        view: of the map.
        neighbours: frames of the same camera, near in time.

    Returns:
        Means over the neighbours; None if none of them shows enough of the view.
    """
    if min(view.camera.size) < _MIN_SIDE_PX or view.compared.mean() < _MIN_KNOWN:
        return None
    moved, known = _flow(view.rgb, view.map_rgb)
    distances = np.linalg.norm(moved - _grid(*view.camera.size), axis=-1)
    # Where the flow does not return, the map does not show what the image shows.
    distances = np.where(known, distances, SIDE_PX)[view.compared]
    offsets = float(np.median(distances)), float((distances > _DISPLACED_PX).mean())
    found = [each for frame in neighbours if (each := _compared(view, frame, offsets)) is not None]
    if not found:
        return None
    return ViewComparison(*(_mean([getattr(c, f.name) for c in found]) for f in fields(found[0])))


def _mean(values: Sequence[float | None]) -> Any:
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


def _compared(view: SmallView, frame: Frame, offsets: tuple[float, float]) -> ViewComparison | None:
    other = _reduced(frame.rgb, view.camera)
    moved, known = _flow(view.rgb, other)
    known &= view.compared
    if known.mean() < _MIN_KNOWN:
        return None
    rgb, carried = view.rgb[known], cv2.remap(other, moved, None, cv2.INTER_CUBIC)[known]
    found = ViewComparison(
        _mean_square(view.map_rgb[known], rgb),
        _mean_square(_exposed_as(view.map_rgb[known], rgb), rgb),
        _mean_square(_exposed_as(carried, rgb), rgb),
        *offsets,
    )
    return found if view.depth_m is None else _with_depth(found, view, frame, moved, known)


def _with_depth(
    found: ViewComparison, view: SmallView, frame: Frame, moved: Image, known: Mask
) -> ViewComparison:
    """Add errors in depth of the map and of a neighbouring frame."""
    assert view.depth_m is not None
    other_m = _nearest(frame.depth_m, view.camera)
    other_m = np.asarray(cv2.remap(other_m, moved, None, cv2.INTER_NEAREST))
    measured = known & (view.depth_m > 0) & (view.map_depth > 0) & (other_m > 0)
    if measured.sum() < _MIN_POINTS:
        return found
    points = (view.camera.rays() * view.depth_m[..., None])[measured]
    errors = (
        np.abs(view.map_depth - view.depth_m)[measured] / view.depth_m[measured],
        _rigid_errors(points, _points(view.camera, moved, other_m)[measured]),
    )
    of_map, of_images = (float(np.minimum(each, _LARGEST).mean()) for each in errors)
    return replace(found, map_depth=of_map, image_depth=of_images)


def _flow(image: Image, other: Image) -> tuple[Image, Mask]:
    """Pixels [H, W, 2] of the other image where that of each pixel is, and where that is known."""
    method = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    grey, other_grey = (
        cv2.cvtColor((255.0 * rgb).clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        for rgb in (image, other)
    )
    there, back = method.calc(grey, other_grey, None), method.calc(other_grey, grey, None)
    height, width = grey.shape
    moved = np.asarray(_grid(width, height) + there, np.float32)
    returned = there + cv2.remap(back, moved, None, cv2.INTER_LINEAR)
    inside = ((moved >= 0) & (moved <= (width - 1, height - 1))).all(axis=-1)
    return moved, inside & (np.linalg.norm(returned, axis=-1) < _MAX_RETURN_PX)


def _rigid_errors(points: Array, others: Array) -> Array:
    """Relative differences [N] in depth of points [N, 3] from others, after a rigid motion."""
    weights = np.ones(len(points))
    z = np.maximum(others[:, 2], 1e-6)
    errors = np.zeros(len(points))
    for _ in range(_ROUNDS):
        share = weights[:, None] / weights.sum()
        centre, other_centre = (share * points).sum(axis=0), (share * others).sum(axis=0)
        u, _, vt = np.linalg.svd((share * (others - other_centre)).T @ (points - centre))
        R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        difference = (points - centre) @ R.T + other_centre - others
        errors = np.abs(difference[:, 2]) / z
        distance = np.linalg.norm(difference, axis=1) / z
        sigma = 1.4826 * float(np.median(distance)) + 1e-9
        # Noise of depth grows with its square.
        weights = 1.0 / (z**2 * (1.0 + (distance / sigma) ** 2))
    return errors


def _grid(width: int, height: int) -> NDArray[np.int64]:
    """Columns and rows [H, W, 2] of the pixels of an image."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)


def _points(camera: Camera, pixels: Image, depth_m: Image) -> Array:
    """Points [H, W, 3] at pixels [H, W, 2] with depth [H, W]."""
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) * depth_m[..., None]


def _exposed_as(colours: Image, others: Image) -> Image:
    """Colours [N, 3] with the gain and bias per channel that fit others."""
    mean, other_mean = colours.mean(axis=0), others.mean(axis=0)
    spread = ((colours - mean) ** 2).mean(axis=0)
    gain = ((colours - mean) * (others - other_mean)).mean(axis=0) / np.maximum(spread, 1e-6)
    gain = np.where(spread > 1e-6, gain, 1.0)
    return np.asarray(gain * (colours - mean) + other_mean)


def _mean_square(colours: Image, others: Image) -> float:
    return float(np.mean((colours.astype(np.float64) - others) ** 2))


def _small_camera(camera: Camera) -> Camera:
    factor = min(1.0, SIDE_PX / max(camera.size))
    width, height = (max(1, round(factor * side)) for side in camera.size)
    return camera.scaled(width / camera.width, height / camera.height, width, height)


def _reduced(image: Image, camera: Camera) -> Image:
    return np.asarray(cv2.resize(image, camera.size, interpolation=cv2.INTER_AREA), np.float32)


def _nearest(depth_m: Image, camera: Camera) -> Image:
    return np.asarray(cv2.resize(depth_m, camera.size, interpolation=cv2.INTER_NEAREST_EXACT))
