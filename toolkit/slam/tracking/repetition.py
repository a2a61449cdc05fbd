"""Other poses at which a frame looks the same, because what it shows repeats.

Before wallpaper, tiles or stripes the cost has a minimum at every period. Shifts of the image at
which it correlates with itself tell where.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.slam.tracking.reach import Reach
from toolkit.slam.tracking.views import RenderedView, Task
from toolkit.splatting.alignment.similarity import MIN_CONTRAST, sampled

Array = NDArray[np.float64]
Image = NDArray[np.float32]

# Width below which an image suffices to find periods, and part of it that is looked for elsewhere.
_WIDTH, _PART = 100, 0.5
# A shift counts if the correlation is this part of that without a shift, and has its maximum within
# so many pixels.
_AS_SIMILAR, _AROUND_PX = 0.8, 2
# Number of other poses, and part of the middle that the map must show to tell that a pose is none.
_MOST, _SEEN = 4, 0.5


def repetitions(task: Task, view: RenderedView, T_map_camera: Array, reach: Reach) -> list[Array]:
    """Poses [4, 4] that the camera can have reached, and where the frame may look the same.

    Args:
        view: of the map, near the pose.
        T_map_camera: [4, 4] of the frame.
    """
    frame = _Comparison.of(task, view, T_map_camera, reach)
    if frame is None:
        return []
    shifts = frame.metres_per_px * frame.periods_px(frame.shown)
    poses = (T_map_camera @ se3.exp(np.array([x, y, 0.0, 0.0, 0.0, 0.0])) for x, y in shifts)
    return [T for T in poses if reach.contains(T)][:_MOST]


def repeats_beyond(task: Task, view: RenderedView, T_map_camera: Array, reach: Reach) -> bool:
    """Whether a frame repeats towards where nothing is mapped, so that the camera may be there.

    Args:
        view: of the map, near the pose.
        T_map_camera: [4, 4] of the frame.
    """
    frame = _Comparison.of(task, view, T_map_camera, reach)
    if frame is None:
        return False
    height, width = frame.size
    known = cv2.boxFilter(frame.known, -1, (width, height), anchor=(0, 0))
    top, left = frame.corner
    shifts = frame.periods_px(frame.own).astype(int)
    return any(known[top + y, left + x] < _SEEN for x, y in shifts)


@dataclass(frozen=True, eq=False)
class _Comparison:
    """A frame, and what the map shows in its place.

    Attributes:
        own, shown: [H, W] intensities of the frame, and of the map. known: [H, W] 1 where the map
            shows something.
        metres_per_px: at the median depth. most_px: maximum shift.
    """

    own: Image
    shown: Image
    known: Image
    metres_per_px: float
    most_px: int

    @classmethod
    def of(
        cls, task: Task, view: RenderedView, T_map_camera: Array, reach: Reach
    ) -> _Comparison | None:
        """At the pose [4, 4] of the frame; None if the camera cannot move by a period."""
        narrow = [k for k, frame in enumerate(task.levels) if frame.camera.width <= _WIDTH]
        level = narrow[0] if narrow else len(task.levels) - 1
        frame, model = task.levels[level], view.levels[level]
        metres_per_px = task.prepared.median_depth_m / frame.camera.fx
        motion = se3.inverse(reach.T_map_camera) @ T_map_camera
        most_px = int((reach.metres + np.linalg.norm(motion[:3, 3])) / metres_per_px)
        if most_px <= _AROUND_PX:
            return None
        own, depth_m = frame.intensity.cpu().numpy(), frame.depth_m.cpu().numpy()
        T_view_camera = se3.inverse(view.T_map_view) @ T_map_camera
        _, view_m, shown = sampled(model, frame.camera, depth_m, T_view_camera)
        return cls(own, shown, (view_m > 0).astype(np.float32), metres_per_px, most_px)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the frame's middle, which is looked for elsewhere."""
        return round(_PART * self.own.shape[0]), round(_PART * self.own.shape[1])

    @property
    def corner(self) -> tuple[int, int]:
        """Row and column of the upper left corner of the middle."""
        (height, width), (rows, columns) = self.size, self.own.shape
        return (rows - height) // 2, (columns - width) // 2

    def periods_px(self, image: Image) -> Array:
        """Shifts [N, 2] at which an image [H, W] looks like the middle, too, the smallest first."""
        (top, left), (height, width) = self.corner, self.size
        part = np.ascontiguousarray(self.own[top : top + height, left : left + width])
        if float(part.std()) < MIN_CONTRAST:
            return np.zeros((0, 2))
        similar = cv2.matchTemplate(image, part, cv2.TM_CCOEFF_NORMED)
        highest = cv2.dilate(similar, np.ones((2 * _AROUND_PX + 1, 2 * _AROUND_PX + 1), np.uint8))
        enough = similar >= _AS_SIMILAR * similar[top, left]
        row, column = np.nonzero((similar == highest) & enough)
        shifts = np.column_stack([column - left, row - top]).astype(np.float64)
        sizes = np.linalg.norm(shifts, axis=1)
        order = np.argsort(sizes, kind="stable")
        return shifts[order][(sizes[order] > _AROUND_PX) & (sizes[order] <= self.most_px)]
