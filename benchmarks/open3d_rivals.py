"""Open3D's own RGB-D SLAM and odometry on one data set, in a process of their own.

Started by compare_open3d.py, one process a rival, so that Open3D has its normal
threads (the toolkit's bridge holds it to one core), a ray cast that hangs can be
killed, and the peak memory is the rival's alone.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
import open3d as o3d
import tyro
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.registry import open_dataset
from toolkit.runs.evaluation.frame_costs import peak_memory_mb
from toolkit.runs.evaluation.trajectory import absolute_trajectory_error, relative_pose_error

RivalName = Literal["dense-slam", "dense-slam-tuned", "odometry", "odometry-planes"]
Array = NDArray[np.float64]

DEPTH_MIN_M = 0.1
DEPTH_OUTLIER_M = 0.07
BLOCK_COUNT = 40_000
TRUNCATION_VOXELS = 8.0
# Three levels from coarse to fine, for the odometry and the tuned SLAM alike. With the
# defaults both stop far from their optimum and would be straw men.
TUNED_ITERATIONS = (30, 20, 10)
# Ray casting can hang for ever on other sizes.
SIZE_MULTIPLE = 8


@dataclass(frozen=True)
class RivalResult:
    """One rival's figures; None where a figure does not exist.

    Times are medians over frames in milliseconds. `failures` counts frames on which
    Open3D itself reported that tracking failed; the pose before was kept there.
    """

    name: str
    frames: int
    ate_rmse_cm: float
    rpe_rotation_deg: float | None
    track_ms: float | None
    integrate_ms: float | None
    ray_cast_ms: float | None
    frame_ms: float | None
    peak_memory_mb: float
    failures: int


@dataclass
class Stopwatch:
    """Collects durations by stage."""

    durations_ms: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.durations_ms[stage].append(1e3 * (time.perf_counter() - start))

    def median_ms(self, stage: str) -> float | None:
        durations = self.durations_ms[stage]
        return float(np.median(durations)) if durations else None


@dataclass(frozen=True)
class Run:
    """What a rival leaves behind."""

    trajectory: Trajectory
    stopwatch: Stopwatch
    failures: int


@dataclass(frozen=True)
class DenseSlamValues:
    """What can be set in Open3D's dense SLAM: voxel size and the tracker's iterations."""

    voxel_size_m: float
    iterations: tuple[int, int, int]


# Voxels of 1 cm are half the time of the default 3/512 m and lose the camera less often on
# the three real sequences of RESULTS.md. "dense-slam" tracks with Open3D's own iterations:
# the fastest and the reference for times; "tuned" has the lowest errors we could find.
DENSE_SLAM_VALUES = {
    "dense-slam": DenseSlamValues(0.01, (6, 3, 1)),
    "dense-slam-tuned": DenseSlamValues(0.01, TUNED_ITERATIONS),
}

# Planes win on noise-free depth, colour and depth together elsewhere.
ODOMETRY_METHODS = {
    "odometry": o3d.t.pipelines.odometry.Method.Hybrid,
    "odometry-planes": o3d.t.pipelines.odometry.Method.PointToPlane,
}


class Rival(Protocol):
    """A method that is given frames one by one."""

    failures: int

    def process(self, frame: Frame) -> Array: ...  # T_world_camera


class DenseSlam:
    """Frame-to-model tracking against a ray-cast TSDF volume (o3d.t.pipelines.slam)."""

    def __init__(
        self, values: DenseSlamValues, camera: Camera, depth_max_m: float, stopwatch: Stopwatch
    ) -> None:
        self.failures = 0
        self._depth_max_m = depth_max_m
        self._stopwatch = stopwatch
        self._criteria = _criteria(values.iterations)
        self._left, self._top, width, height = _window_of_safe_size(camera)
        self._camera = camera.cropped(self._left, self._top, width, height)
        self._device = o3d.core.Device("CPU:0")
        identity = o3d.core.Tensor.from_numpy(np.eye(4))
        self._model = o3d.t.pipelines.slam.Model(
            values.voxel_size_m, 16, BLOCK_COUNT, identity, self._device
        )
        self._input = self._new_frame()
        self._ray_cast = self._new_frame()
        self._T_world_camera = np.eye(4)
        self._index = 0

    def process(self, frame: Frame) -> Array:
        window = np.s_[
            self._top : self._top + self._camera.height,
            self._left : self._left + self._camera.width,
        ]
        depth = np.ascontiguousarray(frame.depth_m[window])
        colour = np.ascontiguousarray(frame.rgb[window])
        self._input.set_data_from_image("depth", o3d.t.geometry.Image(depth))
        self._input.set_data_from_image("color", o3d.t.geometry.Image(colour))
        with self._stopwatch.timed("frame"):
            if self._index > 0:
                with self._stopwatch.timed("track"):
                    self._track()
            self._model.update_frame_pose(
                self._index, o3d.core.Tensor.from_numpy(self._T_world_camera)
            )
            with self._stopwatch.timed("integrate"):
                self._model.integrate(self._input, 1.0, self._depth_max_m, TRUNCATION_VOXELS)
            with self._stopwatch.timed("ray_cast"):
                self._model.synthesize_model_frame(
                    self._ray_cast, 1.0, DEPTH_MIN_M, self._depth_max_m, TRUNCATION_VOXELS, False
                )
        self._index += 1
        return self._T_world_camera

    def _track(self) -> None:
        try:
            result = self._model.track_frame_to_model(
                self._input,
                self._ray_cast,
                1.0,
                self._depth_max_m,
                DEPTH_OUTLIER_M,
                o3d.t.pipelines.odometry.Method.PointToPlane,
                self._criteria,
            )
        except RuntimeError:  # a singular system: Open3D's only report of failure
            self.failures += 1
            return
        step = result.transformation.numpy()
        self._T_world_camera = se3.orthonormalise(self._T_world_camera @ step)

    def _new_frame(self) -> o3d.t.pipelines.slam.Frame:
        return o3d.t.pipelines.slam.Frame(
            self._camera.height,
            self._camera.width,
            o3d.core.Tensor.from_numpy(self._camera.matrix),
            self._device,
        )


class Odometry:
    """Frame-to-frame odometry, started from constant velocity."""

    def __init__(
        self,
        method: o3d.t.pipelines.odometry.Method,
        camera: Camera,
        depth_max_m: float,
        stopwatch: Stopwatch,
    ) -> None:
        self.failures = 0
        self._method = method
        self._depth_max_m = depth_max_m
        self._stopwatch = stopwatch
        self._intrinsics = o3d.core.Tensor.from_numpy(camera.matrix)
        self._criteria = _criteria(TUNED_ITERATIONS)
        self._previous: o3d.t.geometry.RGBDImage | None = None
        self._T_previous_current = np.eye(4)
        self._T_world_camera = np.eye(4)

    def process(self, frame: Frame) -> Array:
        # The hybrid residual weighs intensities in [0, 1] against metres.
        image = o3d.t.geometry.RGBDImage(
            o3d.t.geometry.Image(np.ascontiguousarray(frame.rgb)),
            o3d.t.geometry.Image(np.ascontiguousarray(frame.depth_m)),
        )
        if self._previous is not None:
            with self._stopwatch.timed("frame"), self._stopwatch.timed("track"):
                self._track(image, self._previous)
        self._previous = image
        return self._T_world_camera

    def _track(self, current: o3d.t.geometry.RGBDImage, previous: o3d.t.geometry.RGBDImage) -> None:
        try:
            result = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                current,
                previous,
                self._intrinsics,
                o3d.core.Tensor.from_numpy(self._T_previous_current),
                1.0,
                self._depth_max_m,
                self._criteria,
                self._method,
            )
        except RuntimeError:
            self.failures += 1
            self._T_previous_current = np.eye(4)
            return
        self._T_previous_current = se3.orthonormalise(result.transformation.numpy())
        self._T_world_camera = se3.orthonormalise(self._T_world_camera @ self._T_previous_current)


def _criteria(
    iterations: tuple[int, int, int],
) -> list[o3d.t.pipelines.odometry.OdometryConvergenceCriteria]:
    return [o3d.t.pipelines.odometry.OdometryConvergenceCriteria(n) for n in iterations]


def _window_of_safe_size(camera: Camera) -> tuple[int, int, int, int]:
    """(left, top, width, height) of the largest centred window of a safe size."""
    width = camera.width - camera.width % SIZE_MULTIPLE
    height = camera.height - camera.height % SIZE_MULTIPLE
    return (camera.width - width) // 2, (camera.height - height) // 2, width, height


def run_rival(name: RivalName, frames: Iterable[Frame], camera: Camera, depth_max_m: float) -> Run:
    """Feed all frames to a rival.

    Args:
        name: which of Open3D's methods.
        frames: the sequence; reading a frame is not timed.
        camera: the frames' intrinsics.
        depth_max_m: depth beyond it is ignored, metres.
    """
    stopwatch = Stopwatch()
    rival: Rival
    if name in ODOMETRY_METHODS:
        rival = Odometry(ODOMETRY_METHODS[name], camera, depth_max_m, stopwatch)
    else:
        values = DENSE_SLAM_VALUES[name]
        rival = DenseSlam(values, camera, depth_max_m, stopwatch)
    timestamps_s, poses = [], []
    for frame in frames:
        timestamps_s.append(frame.timestamp_s)
        poses.append(rival.process(frame).copy())
    return Run(Trajectory(np.array(timestamps_s), np.stack(poses)), stopwatch, rival.failures)


def evaluated(name: RivalName, run: Run, truth: Trajectory) -> RivalResult:
    """The figures of a finished run against the truth."""
    rpe = relative_pose_error(run.trajectory, truth)
    return RivalResult(
        name=name,
        frames=len(run.trajectory),
        ate_rmse_cm=100.0 * absolute_trajectory_error(run.trajectory, truth).rmse_m,
        rpe_rotation_deg=rpe.rotation_rmse_deg if rpe else None,
        track_ms=run.stopwatch.median_ms("track"),
        integrate_ms=run.stopwatch.median_ms("integrate"),
        ray_cast_ms=run.stopwatch.median_ms("ray_cast"),
        frame_ms=run.stopwatch.median_ms("frame"),
        peak_memory_mb=peak_memory_mb(),
        failures=run.failures,
    )


def start_all_threads() -> None:
    """Let Open3D's pools form on every core, before the toolkit's bridge narrows them."""
    points = o3d.core.Tensor.from_numpy(
        np.random.default_rng(0).random((200_000, 3), dtype=np.float32)
    )
    cloud = o3d.t.geometry.PointCloud(points).voxel_down_sample(0.01)
    cloud.estimate_normals(max_nn=10, radius=0.1)


@dataclass(frozen=True)
class DatasetArguments:
    """Which frames: as `semsplat run` takes them."""

    kind: str
    path: Path


def main(
    rival: RivalName,
    dataset: DatasetArguments,
    out: Path,
    image_size: tuple[int, int] | None = None,
    max_frames: int | None = None,
    depth_max_m: float = 3.0,
) -> None:
    """Run one of Open3D's methods and write its figures as JSON to `out`."""
    start_all_threads()
    source = open_dataset(dataset.kind, dataset.path, image_size, max_frames)
    if source.ground_truth is None:
        raise SystemExit(f"{dataset.path} has no true trajectory to compare with")
    frames = (source[index] for index in range(len(source)))
    run = run_rival(rival, frames, source.camera, depth_max_m)
    metrics = asdict(evaluated(rival, run, source.ground_truth))
    out.write_text(json.dumps(metrics, indent=2), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
