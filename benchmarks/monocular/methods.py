"""One method that estimates the motion of a camera from images, in a process of its own.

Started by monocular_rivals.py, so that a method that crashes or hangs can be reported, and the
peak memory is its alone.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import Literal

# Open3D and OpenCV must be loaded before pycolmap, or writing PNG files aborts.
import cv2
import numpy as np
import open3d  # noqa: F401
import tyro
from numpy.typing import NDArray

from benchmarks.shared.recordings import opened
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import RecordedDataset
from toolkit.depth.monocular.motion import estimate_motion
from toolkit.runs.evaluation.frame_costs import peak_memory_mb
from toolkit.splatting.alignment.levels import intensity_of

MethodName = Literal["semsplat", "orbslam3", "colmap"]
Grey = NDArray[np.uint8]
Pose = NDArray[np.floating]

# ORB-SLAM3 maps in a thread of its own while the next images are tracked. It is given images at
# this interval, which is several times what it needs for one on the slowest machine.
_INTERVAL_S = 0.15
_TRACKED, _RECENTLY_LOST = "OK", "RECENTLY_LOST"
_ORB_FEATURES = 1000
_SIFT_FEATURES = 2000


@dataclass(frozen=True)
class Options:
    """Estimate the motion of one sequence."""

    method: MethodName
    """What estimates it."""
    sequence: str
    """Key of RECORDINGS or of ROOMS."""
    out: Path
    """File of the result; other files may be written beside it."""
    every: int = 1
    """Use every N-th frame."""
    vocabulary: Path | None = None
    """Words of ORB-SLAM3."""


@dataclass(frozen=True)
class Motion:
    """What a method found.

    Attributes:
        trajectory: poses.
        located: number of frames with a pose, also those whose pose the method does not return.
    """

    trajectory: Trajectory
    located: int


class EveryNth:
    """Every N-th frame of a dataset."""

    def __init__(self, dataset: RecordedDataset, step: int) -> None:
        self._dataset, self._indices = dataset, range(0, len(dataset), step)

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, index: int) -> Frame:
        return self._dataset[self._indices[index]]

    def __iter__(self) -> Iterator[Frame]:
        return (self._dataset[index] for index in self._indices)


def grey(frame: Frame) -> Grey:
    """The grey image [H, W] that all methods are given."""
    return np.round(255.0 * intensity_of(frame.rgb).numpy()).clip(0, 255).astype(np.uint8)


def main() -> None:
    """Estimate the motion and write it."""
    options = tyro.cli(Options)
    cv2.setNumThreads(1)
    dataset = opened(options.sequence)
    frames = EveryNth(dataset, options.every)
    before_s = time.process_time()
    if options.method == "semsplat":
        trajectory = estimate_motion(frames, dataset.camera).trajectory
        motion = Motion(trajectory, len(trajectory))
    elif options.method == "colmap":
        motion = colmap(frames, dataset.camera, options.out.parent)
    else:
        assert options.vocabulary is not None
        motion = orbslam3(frames, dataset.camera, options.out.parent, options.vocabulary)
    np.savez(
        options.out,
        timestamps_s=motion.trajectory.timestamps_s,
        T_world_camera=motion.trajectory.T_world_camera,
        located=motion.located,
        cpu_s=time.process_time() - before_s,
        peak_memory_mb=peak_memory_mb(),
    )


def orbslam3(frames: EveryNth, camera: Camera, folder: Path, vocabulary: Path) -> Motion:
    """Frames that ORB-SLAM3 tracked without a new map in between, the longest series of them.

    The package returns the final poses of only those frames whose keyframe is still in the map.
    """
    maps, poses = tracked_by_orbslam3(frames, camera, folder, vocabulary)
    largest = max(maps, key=len)
    return Motion(_trajectory([(t, T) for t, T in poses if t in largest]), len(largest))


def tracked_by_orbslam3(
    frames: Iterable[Frame], camera: Camera, folder: Path, vocabulary: Path, depth: bool = False
) -> tuple[list[set[float]], list[tuple[float, Pose]]]:
    """Timestamps of the tracked frames of each map, and final poses T_camera_world.

    Args:
        folder: for files.
        depth: use the depth of the frames.
    """
    import orbslam3

    settings, sensor = folder / "orbslam3.yaml", orbslam3.Sensor
    settings.write_text(_orb_settings(camera), encoding="ascii")
    kind = sensor.RGBD if depth else sensor.MONOCULAR
    system = orbslam3.System(str(vocabulary), str(settings), kind)
    system.set_use_viewer(False)
    system.initialize()
    maps: list[set[float]] = [set()]
    for frame in frames:
        begin = time.perf_counter()
        if depth:
            system.process_image_rgbd(grey(frame), frame.depth_m, frame.timestamp_s)
        else:
            system.process_image_mono(grey(frame), frame.timestamp_s)
        state = str(system.get_tracking_state())
        if state == _TRACKED:
            maps[-1].add(frame.timestamp_s)
        elif state != _RECENTLY_LOST:
            maps.append(set())
        time.sleep(max(0.0, _INTERVAL_S - (time.perf_counter() - begin)))
    poses = list(system.get_trajectory_points())
    system.shutdown()
    return maps, poses


def _orb_settings(camera: Camera) -> str:
    """The settings file: the values of its examples, but for the camera.

    Points closer than 40 baselines are near ones; the baseline is that of Kinect's projector.
    """
    values = {
        **{f"Camera1.{name}": getattr(camera, name) for name in ("fx", "fy", "cx", "cy")},
        **{f"Camera1.{name}": 0.0 for name in ("k1", "k2", "p1", "p2")},
        "Camera.width": camera.width,
        "Camera.height": camera.height,
        "Camera.fps": 30,
        "Camera.RGB": 1,
        "ORBextractor.nFeatures": _ORB_FEATURES,
        "ORBextractor.scaleFactor": 1.2,
        "ORBextractor.nLevels": 8,
        "ORBextractor.iniThFAST": 20,
        "ORBextractor.minThFAST": 7,
        "Stereo.b": 0.075,
        "Stereo.ThDepth": 40.0,
        "RGBD.DepthMapFactor": 1.0,
        "Viewer.KeyFrameSize": 0.05,
        "Viewer.KeyFrameLineWidth": 1.0,
        "Viewer.GraphLineWidth": 0.9,
        "Viewer.PointSize": 2.0,
        "Viewer.CameraSize": 0.08,
        "Viewer.CameraLineWidth": 3.0,
        "Viewer.ViewpointX": 0.0,
        "Viewer.ViewpointY": -0.7,
        "Viewer.ViewpointZ": -1.8,
        "Viewer.ViewpointF": 500.0,
    }
    head = '%YAML:1.0\nFile.version: "1.0"\nCamera.type: "PinHole"\n'
    return head + "".join(f"{name}: {value}\n" for name, value in values.items())


def colmap(frames: EveryNth, camera: Camera, folder: Path) -> Motion:
    """Poses of the largest model of COLMAP's incremental mapping."""
    import pycolmap

    images, database = folder / "images", folder / "database.db"
    images.mkdir()
    times_s = {}
    for number, frame in enumerate(frames):
        times_s[f"{number:06d}.png"] = frame.timestamp_s
        cv2.imwrite(str(images / f"{number:06d}.png"), grey(frame))
    # The centre of the first pixel is (0.5, 0.5) in COLMAP.
    parameters = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
    reader = pycolmap.ImageReaderOptions(
        camera_model="PINHOLE", camera_params=", ".join(map(str, parameters))
    )
    extraction = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
    extraction.sift.max_num_features = _SIFT_FEATURES
    pycolmap.extract_features(
        database,
        images,
        camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader,
        extraction_options=extraction,
    )
    pycolmap.match_exhaustive(
        database, matching_options=pycolmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
    )
    mapping = pycolmap.IncrementalPipelineOptions(
        num_threads=1,
        random_seed=0,
        extract_colors=False,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    mapping.mapper.abs_pose_refine_focal_length = False
    mapping.mapper.abs_pose_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, images, folder / "models", mapping)
    largest = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
    found = []
    for image in [] if largest is None else largest.images.values():
        T_camera_world = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
        found.append((times_s[image.name], T_camera_world))
    return Motion(_trajectory(found), len(found))


def _trajectory(poses: Sequence[tuple[float, NDArray[np.floating]]]) -> Trajectory:
    """T_camera_world by their timestamps, as a trajectory."""
    ordered = sorted(poses, key=itemgetter(0))
    T_camera_world = np.array([T for _, T in ordered], np.float64).reshape(-1, 4, 4)
    return Trajectory(np.array([t for t, _ in ordered], np.float64), se3.inverse(T_camera_world))


if __name__ == "__main__":
    main()
