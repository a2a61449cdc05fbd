"""The methods of the benchmark of motion: semsplat, and its rivals on the same frames.

Rivals run in a process of their own, so that one that crashes or hangs can be reported, and that
Open3D has its normal threads there; the toolkit holds it to one.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from multiprocessing.pool import Pool
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.motion_cases import CaseDataset, MixedDataset
from benchmarks.accuracy.silent_errors import Array, Estimate
from benchmarks.shared.recordings import source_of
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.options import as_plain, validated
from toolkit.datasets.base import RecordedDataset, Recording
from toolkit.datasets.registry import describe
from toolkit.runs.building import build_slam
from toolkit.runs.settings import RunSettings, overridden
from toolkit.slam.result import SlamResult

RivalName = Literal["open3d", "opencv", "orbslam3"]
ImageSize = tuple[int, int]

# A rival that takes longer is stopped.
_LIMIT_S = 300
# Depth beyond is ignored: OpenCV's default.
_DEPTH_MAX_M = 4.0


@dataclass(frozen=True)
class CaseSource:
    """The frames of a case.

    Attributes:
        sequence: a key of RECORDINGS or of ROOMS.
        image_size: width and height in pixels; the usual ones of the sequence if None.
        case: a key of CASES.
        seed: of the choice of frames.
        frames: number of frames from the start among which the case chooses; all if None.
    """

    sequence: str
    image_size: ImageSize | None
    case: str
    seed: int = 0
    frames: int | None = None

    def open(self, estimate_shutter: bool = False) -> CaseDataset:
        """The frames; images are loaded on access."""
        recording, usual = _described(self.sequence)
        recording = replace(recording, files=recording.files[: self.frames])
        size = self.image_size or usual
        return CaseDataset(recording, size, self.case, self.seed, estimate_shutter)


def recorded(sequence: str, image_size: ImageSize, seed: int = 0) -> RecordedDataset:
    """All frames of a recording, or of a room of this seed."""
    return RecordedDataset(_described(sequence, seed)[0], image_size)


def _described(sequence: str, seed: int = 0) -> tuple[Recording, ImageSize | None]:
    kind, path, image_size = source_of(sequence, seed)
    return describe(kind, path), image_size


def semsplat(
    dataset: CaseDataset | MixedDataset, seed: int, changes: Mapping[str, Any] | None = None
) -> Estimate:
    """Poses of the finished run.

    Args:
        changes: of the default settings.
    """
    values = overridden(as_plain(RunSettings()), {**(changes or {}), "seed": seed})
    slam = build_slam(dataset, validated(RunSettings, values, "motion"))
    times_s, steps = [], []
    for index in range(len(dataset)):
        frame = dataset[index]
        mapping = slam.process_frame(frame).mapping
        times_s.append(frame.timestamp_s)
        steps.append(getattr(mapping, "steps", None))
    result = slam.finish()
    counted = [number for number in steps if number is not None]
    return Estimate(
        np.array(times_s),
        *poses_by_frame(result),
        frozenset(result.lost_frames),
        frozenset(result.doubtful_frames),
        {
            "keyframes": len(result.keyframe_indices),
            "steps_per_keyframe": float(np.mean(counted)) if counted else None,
        },
    )


def poses_by_frame(result: SlamResult) -> tuple[dict[int, NDArray[np.float64]], dict[int, int]]:
    """Pose [4, 4] of each tracked frame in the frame of its part, and the part's number."""
    main = zip(result.frame_indices, result.trajectory.T_world_camera, strict=True)
    poses, parts = dict(main), dict.fromkeys(result.frame_indices, 0)
    for number, other in enumerate(result.other_parts, start=1):
        own = other.frames
        poses |= dict(zip(own.indices, own.trajectory.T_world_camera, strict=True))
        parts |= dict.fromkeys(own.indices, number)
    return poses, parts


class FrameToFrame(Protocol):
    """A method that estimates the motion since the frame before."""

    failures: int

    def process(self, frame: Frame) -> Array: ...  # T_world_camera


class OpenCvOdometry:
    """OpenCV's odometry of colour and depth, with its default settings.

    It takes no initial estimate. It reports a failure where the system is singular or the motion
    exceeds 15 cm or 15 degrees.

    Args:
        matrix: [3, 3] of the camera.
    """

    def __init__(self, matrix: Array) -> None:
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(matrix.astype(np.float32))
        settings.setMaxDepth(_DEPTH_MAX_M)
        self.failures = 0
        self._odometry = cv2.Odometry(
            cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON
        )
        self._before: cv2.OdometryFrame | None = None
        self._T_world_camera = np.eye(4)

    def process(self, frame: Frame) -> Array:
        """The pose of the next frame; that of the frame before if the method fails."""
        rgb = np.round(255.0 * frame.rgb).clip(0, 255).astype(np.uint8)
        image = cv2.OdometryFrame(frame.depth_m, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        T_before_now = self._motion(image, self._before)
        if T_before_now is not None:
            self._T_world_camera = se3.orthonormalise(self._T_world_camera @ T_before_now)
        elif self._before is not None:
            self.failures += 1
        self._before = image
        return self._T_world_camera

    def _motion(self, now: cv2.OdometryFrame, before: cv2.OdometryFrame | None) -> Array | None:
        try:
            self._odometry.prepareFrame(now)
            if before is None:
                return None
            found, T_before_now = self._odometry.compute(now, before)
        except cv2.error:  # a frame without depth
            return None
        return np.asarray(T_before_now, np.float64) if found else None


def frame_to_frame(dataset: CaseDataset, method: FrameToFrame) -> Estimate:
    """Poses of a method that tracks each frame against the one before.

    A frame on which the method reports a failure is lost, and those after it are another part.
    """
    poses, part, lost = {}, {}, set()
    times_ms = []
    for index in range(len(dataset)):
        frame, before = dataset[index], method.failures
        begin = time.perf_counter()
        T_world_camera = method.process(frame)
        times_ms.append(1e3 * (time.perf_counter() - begin))
        if method.failures > before:
            lost.add(index)
        else:
            poses[index], part[index] = T_world_camera.copy(), len(lost)
    figures = {"frame_ms": float(np.median(times_ms))}
    part = largest_first(part)
    return Estimate(dataset.timestamps_s, poses, part, frozenset(lost), figures=figures)


def largest_first(part: Mapping[int, int]) -> dict[int, int]:
    """The part of each frame, renumbered so that part 0 has the most frames."""
    order = [number for number, _ in Counter(part.values()).most_common()]
    return {index: order.index(number) for index, number in part.items()}


def open3d_odometry(dataset: CaseDataset) -> Estimate:
    """Open3D's hybrid odometry, started from constant velocity, with 30, 20 and 10 iterations."""
    from benchmarks.shared.open3d_rivals import ODOMETRY_METHODS, Odometry, Stopwatch

    hybrid = ODOMETRY_METHODS["odometry"]
    return frame_to_frame(dataset, Odometry(hybrid, dataset.camera, _DEPTH_MAX_M, Stopwatch()))


def orbslam3(dataset: CaseDataset) -> Estimate:
    """Final poses of ORB-SLAM3 with depth; each of its maps is a part."""
    from benchmarks.accuracy.orbslam3 import tracked_by_orbslam3

    with tempfile.TemporaryDirectory() as folder:
        maps, found = tracked_by_orbslam3(dataset, dataset.camera, Path(folder))
    times_s = dataset.timestamps_s
    map_of = {time_s: number for number, own in enumerate(maps) for time_s in own}
    final = {t: se3.inverse(np.asarray(T, np.float64)) for t, T in found if t in map_of}
    poses = {index: final[t] for index, t in enumerate(times_s) if t in final}
    part = largest_first({index: map_of[times_s[index]] for index in poses})
    lost = frozenset(index for index, t in enumerate(times_s) if t not in map_of)
    return Estimate(times_s, poses, part, lost)


def rival_estimate(rival: RivalName, source: CaseSource) -> Estimate:
    """What a rival finds."""
    dataset = source.open()
    if rival == "open3d":
        return open3d_odometry(dataset)
    if rival == "opencv":
        return frame_to_frame(dataset, OpenCvOdometry(dataset.camera.matrix))
    return orbslam3(dataset)


class RivalProcess:
    """A process in which rivals run, one after the other; started when it is first needed."""

    def __init__(self) -> None:
        self._pool: Pool | None = None

    def estimate(self, rival: RivalName, source: CaseSource) -> Estimate | str:
        """What a rival finds, or in a few words why it finds nothing."""
        if rival == "orbslam3" and importlib.util.find_spec(rival) is None:
            return "not installed"
        if self._pool is None:
            # A forked process would lack the threads of this one.
            self._pool = multiprocessing.get_context("spawn").Pool(1)
        found = self._pool.apply_async(rival_estimate, (rival, source))
        try:
            return found.get(_LIMIT_S)
        except multiprocessing.TimeoutError:
            self.close()
            return f"crashed, or no result within {_LIMIT_S} s"

    def close(self) -> None:
        """End the process."""
        if self._pool is not None:
            self._pool.terminate()
            self._pool = None
