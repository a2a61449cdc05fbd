"""The path of the camera: frames with and without a pose, its motion, and where it may be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from toolkit.base.frame import Frame, FrameStamp
from toolkit.base.geometry import se3
from toolkit.slam.frame_covariance import by_shutter, by_view
from toolkit.slam.frame_poses import FramePoses, TrackedFrame
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.health import has_depth
from toolkit.slam.tracking.reach import Reach, mean_pace
from toolkit.slam.tracking.result import TrackingResult, exposure_of
from toolkit.slam.tracking.rolling_shutter import MAX_GAP_S, steady_velocity

Array = NDArray[np.float64]

# Time (seconds) over which the velocity is computed, whatever the frame rate. Over a shorter one,
# it contains more of the errors of the poses, and of the tremor of the hand; older poses do not
# give the present velocity.
_VELOCITY_S = 0.12
# Number of newest frames that may include these poses, if frames are dropped.
_MAX_RECENT = 16
# Motion since the first of several equal images from which their pose is wrong.
_MOVED_M, _MOVED_RAD = 0.05, 0.035
# A camera does not leave what it sees within this time.
_CUT_S = 0.15
# Every so many rows are compared.
_EVERY = 16


class CameraPath(FramePoses):
    """The tracked and the lost frames of a run, in order.

    Attributes:
        lost_frames: reason by index of the frames without a pose, in order.
        unreliable_in_a_row: number of doubtful and lost frames with depth since the last other one.
        dropped_frames: indices of the frames that were not processed; those dropped while the
            camera was lost are lost frames as well.
    """

    def __init__(self) -> None:
        super().__init__()
        self.lost_frames: dict[int, str] = {}
        self.unreliable_in_a_row = 0
        self.dropped_frames: list[int] = []
        self._cut, self._pace = False, 0.0

    def add(
        self,
        frame: Frame,
        atlas: Atlas,
        T_submap_camera: Array,
        tracking: TrackingResult | None,
        steps: int = 0,
        fingerprint: int = 0,
    ) -> None:
        """Add a frame of the active submap, relative to its newest keyframe.

        Args:
            T_submap_camera: [4, 4]. tracking: None or lost for a frame that was not located.
            steps: number of optimisation steps on a keyframe.
            fingerprint: `fingerprint` of the frame as it was recorded.
        """
        last = atlas.keyframes[-1]
        # The map follows the exposures of its keyframes, not those of tracking.
        exposure = last.exposure if frame.index == last.index else exposure_of(tracking)
        doubt = tracking.reason if tracking is not None and tracking.doubtful else ""
        self.unreliable_in_a_row = self.unreliable_in_a_row + 1 if doubt else 0
        self._cut = False
        covariance = by_view(frame, tracking)
        if self._frames and tracking is not None and not tracking.lost:
            velocity = self._last_motion(frame, atlas, T_submap_camera)
            if frame.readout_sigma_s > 0.0 and covariance.any():
                covariance = covariance + by_shutter(frame, velocity)
            if not (doubt or self._frames[-1].doubt):
                self._pace = mean_pace(self._pace, velocity)
        tracked = TrackedFrame(
            frame.index,
            frame.timestamp_s,
            atlas.active,
            last.index,
            exposure,
            doubt,
            bool(doubt) and tracking is not None and tracking.ambiguous,
            steps,
            fingerprint,
        )
        self._append(tracked, se3.inverse(last.T_map_camera) @ T_submap_camera, covariance)

    def _last_motion(self, frame: Frame, atlas: Atlas, T_submap_camera: Array) -> Array:
        """Mean velocity [6] (m/s, rad/s) from the newest frame to the next one."""
        number, T_last = self.last_pose(atlas)
        T_world_camera = atlas.T_world_submap(atlas.active) @ T_submap_camera
        T_world_last = atlas.T_world_submap(number) @ T_last
        elapsed_s = frame.timestamp_s - self._frames[-1].timestamp_s
        return se3.log(se3.inverse(T_world_last) @ T_world_camera) / elapsed_s

    def add_lost(
        self, frame: Frame, reason: str, tried: bool = True, ambiguous: bool = False
    ) -> None:
        """Add a frame without a pose, and why it has none.

        Args:
            tried: whether the camera could have been located in this frame.
            ambiguous: whether it looks like a place where the camera cannot be.
        """
        self.lost_frames[frame.index] = reason
        tried &= has_depth(frame)
        self.unreliable_in_a_row += tried
        if tried and not ambiguous:
            self._cut = self._is_after_cut(frame)

    def disorder(self, frame: FrameStamp) -> str:
        """Why a frame cannot follow the newest frame with a pose in time; empty if it can."""
        if not np.isfinite(frame.timestamp_s):
            return "its time is not finite"
        if self._frames and frame.timestamp_s <= self._frames[-1].timestamp_s:
            return (
                f"its time, {frame.timestamp_s:.3f} s, is not after that of frame "
                f"{self._frames[-1].index}"
            )
        return ""

    def add_dropped(self, frame: FrameStamp) -> bool:
        """Add a frame that was not processed, at the pose of the frame before it.

        While the camera is lost, the frame is lost as well, but it does not count as an attempt to
        locate the camera.

        Returns:
            Whether the frame has a pose.
        """
        self.dropped_frames.append(frame.index)
        disorder = self.disorder(frame)
        if self._is_lost or disorder:
            self.lost_frames[frame.index] = disorder or "dropped while the camera was lost"
            return False
        self._append_last(frame, self._frames[-1].doubt)
        return True

    def repeats(self, fingerprint: int) -> bool:
        """Whether a frame shows the images of the newest frame with a pose again, to the bit.

        Noise makes the images of any sensor differ: these were stored or sent twice.

        Args:
            fingerprint: `fingerprint` of the frame as it was recorded.
        """
        return not self._is_lost and self._frames[-1].fingerprint == fingerprint

    def add_repeated(self, frame: Frame, atlas: Atlas) -> str:
        """Add a frame that repeats the images of the newest one, at its pose.

        Returns:
            Why the pose may be wrong; empty if the camera has hardly moved since.
        """
        first = next(f for f in reversed(self._frames) if not f.repeats)
        velocity = self.velocity(atlas, first)
        elapsed_s, doubt = frame.timestamp_s - first.timestamp_s, ""
        moved = np.zeros(6) if velocity is None else velocity * elapsed_s
        metres, radians = np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])
        if metres > _MOVED_M or radians > _MOVED_RAD:
            doubt = f"its images are those of frame {first.index}, and the camera has moved on"
        self._append_last(frame, doubt, repeats=True)
        self._covariances[-1] = self._covariances[-1] + np.outer(moved, moved)
        return doubt

    def _append_last(self, frame: FrameStamp, doubt: str, repeats: bool = False) -> None:
        """Add a frame at the pose of the newest one."""
        last = replace(self._frames[-1], index=frame.index, timestamp_s=frame.timestamp_s)
        last = replace(last, doubt=doubt, steps=0, repeats=repeats)
        self._append(last, self._T_keyframe_camera[-1], self._covariances[-1])

    @property
    def _is_lost(self) -> bool:
        """Whether the newest frame has no pose, or there is none yet."""
        if not self._frames:
            return True
        return max(self.lost_frames, default=-1) > self._frames[-1].index

    @property
    def last_reliable_s(self) -> float | None:
        """Time of the newest frame that is neither doubtful nor lost; None without any."""
        return next((f.timestamp_s for f in reversed(self._frames) if not f.doubt), None)

    @property
    def doubtful_frames(self) -> dict[int, str]:
        """Reason by index of the frames whose pose may be wrong, in order."""
        return {f.index: f.doubt for f in self._frames if f.doubt}

    def velocity(
        self, atlas: Atlas, frame: FrameStamp, T_submap_camera: Array | None = None
    ) -> Array | None:
        """Velocity [6] (m/s, rad/s) of the camera in its own frame.

        Args:
            frame: the next frame.
            T_submap_camera: [4, 4] its pose in the active submap. Without it, the velocity is the
                mean over the last poses; with it, that from the last pose to it.

        Returns:
            None without two recent poses since a frame was lost, and where the motion or the times
            are irregular.
        """
        first_allowed = max(self.lost_frames, default=-1) + 1
        dropped = set(self.dropped_frames[-_MAX_RECENT:])
        recent = [
            (f, T)
            for f, T in zip(
                self._frames[-_MAX_RECENT:], self._T_keyframe_camera[-_MAX_RECENT:], strict=True
            )
            if f.index >= first_allowed and not (f.doubt or f.repeats) and f.index not in dropped
        ]
        if not recent or frame.timestamp_s - recent[-1][0].timestamp_s > MAX_GAP_S:
            return None
        newest_s = recent[-1][0].timestamp_s
        recent = [(f, T) for f, T in recent if newest_s - f.timestamp_s <= _VELOCITY_S]
        poses = [
            atlas.T_world_submap(f.submap) @ atlas.keyframe_poses(f.submap)[f.keyframe] @ T
            for f, T in recent
        ]
        times_s = [f.timestamp_s for f, _ in recent]
        known = steady_velocity(poses, times_s)
        if known is None or T_submap_camera is None:
            return known
        poses.append(atlas.T_world_submap(atlas.active) @ T_submap_camera)
        return steady_velocity(poses[-2:], [times_s[-1], frame.timestamp_s])

    def reach(self, atlas: Atlas, frame: FrameStamp) -> Reach | None:
        """Where the camera may be in the world at the next frame, which is lost.

        None without frames, and after a cut of the recording.
        """
        if not self._frames or self._is_after_cut(frame):
            return None
        reliable = [k for k, one in enumerate(self._frames) if not one.doubt]
        first = reliable[-1] if reliable else 0
        # Until the evidence spoke against a pose.
        wrong = [k for k in range(first + 1, len(self._frames)) if not self._frames[k].ambiguous]
        last = wrong[0] - 1 if wrong else len(self._frames) - 1
        number, T_submap_camera = self._pose(atlas, last)
        T_world_camera = atlas.T_world_submap(number) @ T_submap_camera
        last_s = self._frames[last].timestamp_s
        doubtful_s = last_s - self._frames[first].timestamp_s
        return Reach.after(T_world_camera, frame.timestamp_s - last_s, doubtful_s, self._pace)

    def _is_after_cut(self, frame: FrameStamp) -> bool:
        """Whether the recording was cut before a lost frame.

        It was if nothing of a reliable frame is seen a moment later.
        """
        if self._cut or not self._frames or self._frames[-1].doubt:
            return self._cut
        return frame.timestamp_s - self._frames[-1].timestamp_s <= _CUT_S

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        arrays, values = super().state()
        return arrays, values | {
            "lost_frames": list(self.lost_frames.items()),
            "unreliable_in_a_row": self.unreliable_in_a_row,
            "dropped_frames": self.dropped_frames,
            "cut": self._cut,
            "pace": self._pace,
        }

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        super().restore(arrays, values)
        self.lost_frames = {int(index): reason for index, reason in values["lost_frames"]}
        self.unreliable_in_a_row = int(values["unreliable_in_a_row"])
        self.dropped_frames = [int(i) for i in values["dropped_frames"]]
        self._cut, self._pace = bool(values["cut"]), float(values["pace"])


def fingerprint(frame: Frame) -> int:
    """A number that differs between the images of any two exposures."""
    rows = (image[::_EVERY].tobytes() for image in (frame.rgb, frame.depth_m))
    return crc32(b"".join(rows))
