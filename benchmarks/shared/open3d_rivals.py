"""Open3D's own RGB-D SLAM and odometry on one data set, in a process of their own.

`accuracy.compare_open3d` starts a process for each rival, so that Open3D has its normal threads
(the toolkit's bridge holds it to one core), a ray cast that hangs can be killed, and the peak
memory is the rival's alone.
"""

from __future__ import annotations

import json
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
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

DEPTH_MIN_M, DEPTH_OUTLIER_M = 0.1, 0.07
BLOCK_COUNT, TRUNCATION_VOXELS = 40_000, 8.0
# Half the time of the default 3/512 m, and the camera is lost less often on the real sequences.
VOXEL_M = 0.01
# Three levels from coarse to fine, for the odometry and the tuned SLAM alike. With the
# defaults both stop far from their optimum and would be straw men.
TUNED_ITERATIONS = (30, 20, 10)
# "dense-slam" tracks with Open3D's own iterations: the fastest and the reference for times.
DENSE_SLAM_ITERATIONS = {"dense-slam": (6, 3, 1), "dense-slam-tuned": TUNED_ITERATIONS}
# Planes win on noise-free depth, colour and depth together elsewhere.
ODOMETRY_METHODS = {
    "odometry": o3d.t.pipelines.odometry.Method.Hybrid,
    "odometry-planes": o3d.t.pipelines.odometry.Method.PointToPlane,
}
# Ray casting can hang for ever on other sizes.
SIZE_MULTIPLE = 8


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


class Rival(Protocol):
    """A method that is given frames one by one; failures are those that Open3D reports."""

    failures: int

    def process(self, frame: Frame) -> Array: ...  # T_world_camera


class DenseSlam:
    """Frame-to-model tracking against a ray-cast TSDF volume (o3d.t.pipelines.slam)."""

    def __init__(
        self,
        iterations: tuple[int, int, int],
        camera: Camera,
        depth_max_m: float,
        stopwatch: Stopwatch,
    ) -> None:
        self.failures, self._index = 0, 0
        self._depth_max_m, self._stopwatch = depth_max_m, stopwatch
        self._criteria = _criteria(iterations)
        # The largest centred window of a safe size.
        width, height = (n - n % SIZE_MULTIPLE for n in camera.size)
        left, top = (camera.width - width) // 2, (camera.height - height) // 2
        self._window = np.s_[top : top + height, left : left + width]
        self._camera = camera.cropped(left, top, width, height)
        self._device = o3d.core.Device("CPU:0")
        identity = o3d.core.Tensor.from_numpy(np.eye(4))
        self._model = o3d.t.pipelines.slam.Model(VOXEL_M, 16, BLOCK_COUNT, identity, self._device)
        self._input, self._ray_cast = self._new_frame(), self._new_frame()
        self._T_world_camera = np.eye(4)

    def process(self, frame: Frame) -> Array:
        """The pose of the next frame; that of the frame before if tracking fails."""
        for kind, image in (("depth", frame.depth_m), ("color", frame.rgb)):
            shown = o3d.t.geometry.Image(np.ascontiguousarray(image[self._window]))
            self._input.set_data_from_image(kind, shown)
        with self._stopwatch.timed("frame"):
            if self._index > 0:
                with self._stopwatch.timed("track"):
                    self._track()
            pose = o3d.core.Tensor.from_numpy(self._T_world_camera)
            self._model.update_frame_pose(self._index, pose)
            with self._stopwatch.timed("integrate"):
                self._model.integrate(self._input, 1.0, self._depth_max_m, TRUNCATION_VOXELS)
            with self._stopwatch.timed("ray_cast"):
                self._model.synthesize_model_frame(
                    self._ray_cast, 1.0, DEPTH_MIN_M, self._depth_max_m, TRUNCATION_VOXELS, False
                )
        self._index += 1
        return self._T_world_camera

    def _track(self) -> None:
        planes = o3d.t.pipelines.odometry.Method.PointToPlane
        depths = 1.0, self._depth_max_m, DEPTH_OUTLIER_M
        try:
            result = self._model.track_frame_to_model(
                self._input, self._ray_cast, *depths, planes, self._criteria
            )
        except RuntimeError:  # a singular system: Open3D's only report of failure
            self.failures += 1
            return
        step = result.transformation.numpy()
        self._T_world_camera = se3.orthonormalise(self._T_world_camera @ step)

    def _new_frame(self) -> o3d.t.pipelines.slam.Frame:
        matrix = o3d.core.Tensor.from_numpy(self._camera.matrix)
        size = self._camera.height, self._camera.width
        return o3d.t.pipelines.slam.Frame(*size, matrix, self._device)


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
        self._method, self._depth_max_m, self._stopwatch = method, depth_max_m, stopwatch
        self._intrinsics = o3d.core.Tensor.from_numpy(camera.matrix)
        self._criteria = _criteria(TUNED_ITERATIONS)
        self._previous: o3d.t.geometry.RGBDImage | None = None
        self._T_previous_current = np.eye(4)
        self._T_world_camera = np.eye(4)

    def process(self, frame: Frame) -> Array:
        """The pose of the next frame; that of the frame before if the method fails."""
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
        start = o3d.core.Tensor.from_numpy(self._T_previous_current)
        depths = 1.0, self._depth_max_m
        try:
            result = o3d.t.pipelines.odometry.rgbd_odometry_multi_scale(
                current, previous, self._intrinsics, start, *depths, self._criteria, self._method
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


def start_all_threads() -> None:
    """Let Open3D's pools form on every core, before the toolkit's bridge narrows them."""
    points = np.random.default_rng(0).random((200_000, 3), dtype=np.float32)
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(points))
    cloud.voxel_down_sample(0.01).estimate_normals(max_nn=10, radius=0.1)


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
    watch = Stopwatch()
    method: Rival
    if rival in ODOMETRY_METHODS:
        method = Odometry(ODOMETRY_METHODS[rival], source.camera, depth_max_m, watch)
    else:
        method = DenseSlam(DENSE_SLAM_ITERATIONS[rival], source.camera, depth_max_m, watch)
    times_s, poses = [], []
    for index in range(len(source)):
        frame = source[index]
        times_s.append(frame.timestamp_s)
        poses.append(method.process(frame).copy())
    path = Trajectory(np.array(times_s), np.stack(poses))
    relative = relative_pose_error(path, source.ground_truth)
    figures = {
        "ate_rmse_cm": 100.0 * absolute_trajectory_error(path, source.ground_truth).rmse_m,
        "rpe_rotation_deg": relative.rotation_rmse_deg if relative else None,
        **{f"{s}_ms": watch.median_ms(s) for s in ("track", "integrate", "ray_cast", "frame")},
        "peak_memory_mb": peak_memory_mb(),
        "failures": method.failures,
    }
    out.write_text(json.dumps(figures, indent=2), encoding="utf-8")


if __name__ == "__main__":
    tyro.cli(main)
