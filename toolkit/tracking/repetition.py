"""Other poses at which a frame looks the same, because what it shows repeats.

Before wallpaper, tiles or stripes the cost has a minimum at every period. Shifts of the image at
which it correlates with itself tell where.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.alignment.similarity import MIN_CONTRAST, sampled
from toolkit.geometry import se3
from toolkit.tracking.reach import Reach
from toolkit.tracking.views import RenderedView, Task

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# Width below which an image suffices to find periods, and part of it that is looked for elsewhere.
_WIDTH, _PART = 100, 0.5
# A shift counts if the correlation is this part of that without a shift, and has its maximum within
# so many pixels.
_AS_SIMILAR, _AROUND_PX = 0.8, 2
# Number of other poses.
_MOST = 4


def repetitions(task: Task, view: RenderedView, T_map_camera: Array, reach: Reach) -> list[Array]:
    """Poses [4, 4] that the camera can have reached, and where the frame may look the same.

    Args:
        view: of the map, near the pose.
        T_map_camera: [4, 4] of the frame.
    """
    level = next(
        (k for k, frame in enumerate(task.levels) if frame.camera.width <= _WIDTH),
        len(task.levels) - 1,
    )
    frame, model = task.levels[level], view.levels[level]
    camera, depth_m = frame.camera, frame.depth_m.cpu().numpy()
    metres_per_px = task.prepared.median_depth_m / camera.fx
    motion = se3.inverse(reach.T_map_camera) @ T_map_camera
    most_px = int((reach.metres + np.linalg.norm(motion[:3, 3])) / metres_per_px)
    if most_px <= _AROUND_PX:
        return []
    own = frame.intensity.cpu().numpy()
    _, _, shown = sampled(model, camera, depth_m, se3.inverse(view.T_map_view) @ T_map_camera)
    shifts = metres_per_px * _periods_px(own, shown, most_px)
    poses = (T_map_camera @ se3.exp(np.array([x, y, 0.0, 0.0, 0.0, 0.0])) for x, y in shifts)
    return [T for T in poses if reach.contains(T)][:_MOST]


def _periods_px(own: Image, shown: Image, most_px: int) -> Array:
    """Shifts [N, 2] at which a view [H, W] looks like a frame's middle again, from the smallest."""
    height, width = (round(_PART * size) for size in own.shape)
    top, left = (own.shape[0] - height) // 2, (own.shape[1] - width) // 2
    part = np.ascontiguousarray(own[top : top + height, left : left + width])
    if float(part.std()) < MIN_CONTRAST:
        return np.zeros((0, 2))
    similar = cv2.matchTemplate(shown, part, cv2.TM_CCOEFF_NORMED)
    highest = cv2.dilate(similar, np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8))
    row, column = np.nonzero((similar == highest) & (similar >= _AS_SIMILAR * similar[top, left]))
    shifts = np.column_stack([column - left, row - top]).astype(np.float64)
    sizes = np.linalg.norm(shifts, axis=1)
    order = np.argsort(sizes, kind="stable")
    return shifts[order][(sizes[order] > _AROUND_PX) & (sizes[order] <= most_px)]
