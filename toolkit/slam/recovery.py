"""Recovery of a lost camera: relocalisation in the existing submaps, or a new submap."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.exposure import IDENTITY
from toolkit.base.frame import Frame, FrameStamp, Recorder
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.base.stages import Stage
from toolkit.slam.camera_path import CameraPath
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops.relocalisation import Relocalisation
from toolkit.slam.mapping.boundary import start_at
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.submaps.atlas import Atlas
from toolkit.slam.tracking.confirmation import shows_same_place
from toolkit.slam.tracking.health import has_depth
from toolkit.slam.tracking.reach import Reach
from toolkit.slam.tracking.result import Health, TrackingResult
from toolkit.slam.tracking.tracker import LocatingTracker, PartTracker

_log = logging.getLogger(__name__)

# Fewer unreliable frames in a row do not end a submap, however long they take.
_MIN_UNRELIABLE = 3
# Time without a reliable frame after which that many end it: at a low frame rate, the camera moves
# far in the frames of `patience`.
_PATIENCE_S = 1.0


@dataclass(frozen=True)
class Located:
    """Pose of a frame.

    Attributes:
        T_map_camera: [4, 4] pose in the frame of the active submap; None if the frame is lost.
        tracking: the result of tracking or relocalisation; None for the frame that starts the
            map. Its status is LOST for a frame that starts a submap of unknown position.
    """

    T_map_camera: NDArray[np.float64] | None
    tracking: TrackingResult | None = None

    @property
    def doubtful(self) -> bool:
        """Whether the pose may be wrong, so that the frame must not extend the map."""
        return self.tracking is not None and self.tracking.doubtful


class Recovery:
    """Relocalises lost frames, and starts a new submap if relocalisation fails for too long.

    Args:
        label: adds labels to a frame that becomes the first keyframe of a submap.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        mapper: Mapper,
        atlas: Atlas,
        path: CameraPath,
        label: Callable[[Frame], Frame],
        recorder: Recorder,
    ) -> None:
        self._tracker, self._closer = front_end.tracker, front_end.closer
        self._mapper, self._atlas, self._path = mapper, atlas, path
        self._label, self._recorder = label, recorder
        self._unreliable: Frame | None = None

    def out_of_patience(self, frame: FrameStamp) -> bool:
        """Whether the frames before this one were unreliable for so long that a submap may start.

        Frames are unreliable if they are doubtful or lost.
        """
        relocaliser, path = self._closer.relocaliser, self._path
        if relocaliser is None:
            return False
        options = relocaliser.options
        if path.unreliable_in_a_row >= options.patience:
            return True
        last = path.last_reliable_s
        waited_s = 0.0 if last is None else frame.timestamp_s - last
        return path.unreliable_in_a_row >= _MIN_UNRELIABLE and waited_s >= _PATIENCE_S

    def recover(self, frame: Frame, lost: TrackingResult, may_map: bool) -> Located:
        """Relocalise a lost frame.

        If it is found in the active submap, tracking continues there. If it is found in another
        submap, or too many frames were unreliable in a row, a new submap starts at the frame; in
        the latter case only where it can be aligned to the unreliable frame before it. Frames
        without depth are ignored.

        Args:
            lost: the result of tracking.
            may_map: False for a frame that must not start a submap.
        """
        tracker, relocaliser = self._tracker, self._closer.relocaliser
        if isinstance(tracker, PartTracker):
            return self._entered_part(tracker, frame, lost, may_map)
        if relocaliser is None or not isinstance(tracker, LocatingTracker):
            return Located(None, lost)
        if not has_depth(frame):
            return Located(None, lost)
        out_of_patience = self.out_of_patience(frame)
        with self._recorder.timed(Stage.RELOCALISATION):
            reach, found = self._path.reach(self._atlas, frame), None
            if not lost.ambiguous:
                parts = self._closer.parts(self._atlas)
                part = next(part for part in parts if self._atlas.active in part)
                found = relocaliser.find(frame, self._atlas, tracker, reach, part)
        active = self._atlas.active if self._atlas.has_active_submap else None
        if found is not None and found.submap == active:
            tracker.continue_from(frame.timestamp_s, found.T_submap_camera)
            _log.info("Relocalised frame %d in active submap %d.", frame.index, found.submap)
            return Located(found.T_submap_camera, found.result)
        if not may_map:
            return Located(None, lost)
        if found is None and not (out_of_patience and self._may_start(frame)):
            self._unreliable = frame
            return Located(None, lost)
        if found is None:
            place = self._path.last_pose(self._atlas)
        else:
            place = found.submap, found.T_submap_camera
        self._start_submap(frame, found, place, reach)
        _log.warning(
            "Started submap %d at frame %d: %s.",
            self._atlas.active,
            frame.index,
            f"relocalised in submap {found.submap}"
            if found is not None
            else "relocalisation failed, position unknown until a loop is found",
        )
        tracker.continue_from(frame.timestamp_s, np.eye(4))
        if found is None:
            return Located(np.eye(4), replace(lost, health=Health.LOST))
        return Located(np.eye(4), replace(found.result, T_map_camera=np.eye(4)))

    def _entered_part(
        self, tracker: PartTracker, frame: Frame, lost: TrackingResult, may_map: bool
    ) -> Located:
        """Start a submap where the poses go on in another part of the trajectory."""
        T_world_camera = tracker.pose_in_other_part(frame)
        if T_world_camera is None:
            return Located(None, lost)
        if not may_map or not has_depth(frame):
            return Located(None, replace(lost, reason="its part of the map has not started"))
        active = self._atlas.active
        T_active_world = se3.inverse(self._atlas.T_world_submap(active))
        self._start_submap(frame, None, (active, T_active_world @ T_world_camera), None)
        _log.warning(
            "Started submap %d at frame %d, in another part of the motion.",
            self._atlas.active,
            frame.index,
        )
        tracker.enter(frame)
        return Located(np.eye(4), replace(lost, health=Health.LOST))

    def _may_start(self, frame: Frame) -> bool:
        """Whether a submap of unknown position may start at a frame."""
        before = self._unreliable
        return (
            before is not None
            and shows_same_place(before, frame)
            and self._tracker.first_pose(frame) is not None
        )

    def state(self) -> tuple[dict[str, NDArray], dict[str, Any]]:
        """Arrays and JSON values from which `restore` continues identically."""
        frame = self._unreliable
        if frame is None:
            return {}, {}
        stamp = {"index": frame.index, "timestamp_s": frame.timestamp_s}
        return {"rgb": frame.rgb, "depth_m": frame.depth_m}, stamp | {
            "camera": asdict(frame.camera)
        }

    def restore(self, arrays: dict[str, NDArray], values: dict[str, Any]) -> None:
        """Restore an earlier `state`."""
        self._unreliable = None
        if values:
            rgb, depth_m = np.array(arrays["rgb"]), np.array(arrays["depth_m"])
            camera = Camera(**values["camera"])
            self._unreliable = Frame(values["index"], values["timestamp_s"], rgb, depth_m, camera)

    def _start_submap(
        self,
        frame: Frame,
        found: Relocalisation | None,
        place: tuple[int, NDArray[np.float64]],
        reach: Reach | None,
    ) -> None:
        """Start a submap at a frame.

        Args:
            found: the relocalisation of the frame; None if its pose is not known by one.
            place: submap and T_submap_camera [4, 4] where it starts.
            reach: where the camera may be in the world; None if that is unknown.
        """
        atlas = self._atlas
        exposure = IDENTITY if found is None else found.result.exposure
        anchor = Keyframe.from_frame(self._label(frame), np.eye(4), exposure)
        self._closer.submap_ending(atlas, self._mapper)
        ended = atlas.active
        with self._recorder.timed(Stage.MAPPING):
            start_at(atlas, self._mapper, anchor, place, inherit=found is not None)
        self._closer.submap_recovered(atlas, ended, found, reach)
