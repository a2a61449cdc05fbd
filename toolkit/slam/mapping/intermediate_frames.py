"""Frames between two keyframes: surfaces outside both keyframes' images, and more views to fit.

Where the camera turns back between two keyframes, only frames between them show what it has seen
farthest out. Without Gaussians there, these views have black borders.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe, evenly_spaced
from toolkit.io.arrays import arrays_below
from toolkit.slam.submaps.intermediate_views import IntermediateView

# A frame with a smaller fraction of its measured pixels outside both keyframes is not used.
MIN_OUTSIDE = 0.001
# The fraction is estimated from about this many pixels per row.
_SAMPLES = 80
# Limits memory where keyframes are far apart.
_MAX_FRAMES = 8
# Frames wait in real-time operation only. Limits memory where there is never any time for them.
_MAX_WAITING = 32


@dataclass(frozen=True)
class IntermediateFrame:
    """A tracked frame since the newest keyframe.

    Attributes:
        keyframe: frame index of that keyframe.
        T_keyframe_camera: [4, 4] pose relative to it.
        exposure: of the frame against the map.
    """

    frame: Frame
    keyframe: int
    T_keyframe_camera: NDArray[np.float64]
    exposure: Exposure

    def at_map_exposure(self) -> Frame:
        """The frame with the colours that the map would have there."""
        rgb = self.exposure.apply(self.frame.rgb)
        return replace(self.frame, rgb=rgb.astype(np.float32))


class IntermediateFrames:
    """The last tracked frames since the newest keyframe, and those that wait to be mapped.

    Args:
        fill_holes: whether frames wait to be mapped.
        max_views: maximum number of views between two keyframes.
        measured: whether the depth of the frames is measured; views have none otherwise.
    """

    def __init__(self, fill_holes: bool = True, max_views: int = 0, measured: bool = True) -> None:
        self._fill_holes, self._max_views, self._measured = fill_holes, max_views, measured
        self._frames: deque[IntermediateFrame] = deque(maxlen=_MAX_FRAMES)
        self._outside: deque[IntermediateFrame] = deque(maxlen=_MAX_WAITING)

    def add(
        self,
        frame: Frame,
        keyframe: Keyframe,
        T_map_camera: NDArray[np.float64],
        exposure: Exposure,
    ) -> None:
        """Add a tracked frame after a keyframe, whose white balance it is given."""
        if not self._fill_holes and not self._max_views:
            return
        exposure = exposure.with_balance(keyframe.exposure.balance)
        T_keyframe_camera = se3.inverse(keyframe.T_map_camera) @ T_map_camera
        self._frames.append(IntermediateFrame(frame, keyframe.index, T_keyframe_camera, exposure))

    def select(self, last: Keyframe, newest: Keyframe | None = None) -> list[IntermediateView]:
        """Let those frames wait that show surfaces outside two keyframes; remove the others.

        Args:
            last: the keyframe before the frames, at its present pose.
            newest: the keyframe after them; None at the end of the sequence.

        Returns:
            Some of all the frames, for the final refinement.
        """
        # Others were tracked in another submap.
        own = [between for between in self._frames if between.keyframe == last.index]
        self._frames.clear()
        for between in own if self._fill_holes else ():
            T_map_camera = last.T_map_camera @ between.T_keyframe_camera
            points_map = se3.transform_points(T_map_camera, _samples(between.frame))
            outside = ~last.shows(points_map)
            if newest is not None:
                outside &= ~newest.shows(points_map)
            if outside.sum() > MIN_OUTSIDE * len(outside):
                self._outside.append(between)
        return [self._view(between) for between in evenly_spaced(own, self._max_views)]

    def _view(self, between: IntermediateFrame) -> IntermediateView:
        frame = between.frame
        if not self._measured:
            frame = replace(frame, depth_m=np.zeros_like(frame.depth_m))
        return IntermediateView.of(
            frame, between.keyframe, between.T_keyframe_camera, between.exposure
        )

    def take(self) -> IntermediateFrame | None:
        """Remove and return the first frame that waits to be mapped, if there is one."""
        return self._outside.popleft() if self._outside else None

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically.

        Like other deferred work, frames that wait are not included.
        """
        arrays: dict[str, NDArray] = {}
        values = []
        for number, between in enumerate(self._frames):
            frame = between.frame
            names = ("rgb", "depth_m", "labels", "ignored")
            named = {name: getattr(frame, name) for name in names}
            named["T_keyframe_camera"] = between.T_keyframe_camera
            arrays |= {f"{number}/{name}": a for name, a in named.items() if a is not None}
            values.append(
                {
                    "index": frame.index,
                    "timestamp_s": frame.timestamp_s,
                    "camera": asdict(frame.camera),
                    "keyframe": between.keyframe,
                    "exposure": asdict(between.exposure),
                }
            )
        return arrays, {"frames": values}

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._frames.clear()
        self._outside.clear()
        for number, saved in enumerate(values["frames"]):
            own: dict[str, Any] = {
                name: np.array(a) for name, a in arrays_below(arrays, f"{number}/").items()
            }
            T_keyframe_camera = own.pop("T_keyframe_camera")
            camera = Camera(**saved["camera"])
            frame = Frame(saved["index"], saved["timestamp_s"], camera=camera, **own)
            exposure = Exposure.from_values(saved["exposure"])
            self._frames.append(
                IntermediateFrame(frame, saved["keyframe"], T_keyframe_camera, exposure)
            )


def _samples(frame: Frame) -> NDArray[np.float64]:
    """Measured points [P, 3] of a frame in camera coordinates, evenly spaced in the image."""
    points = frame.camera.unproject(frame.depth_m, max(1, frame.camera.width // _SAMPLES))
    return points[points[..., 2] > 0]
