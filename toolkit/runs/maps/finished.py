"""Load the settings, map and poses of a finished run."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, RunFolderError, SettingsError
from toolkit.base.exposure import Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.image_sides import SIDES, ImageSide
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.base import RecordedDataset
from toolkit.datasets.estimates import RecordingEstimates
from toolkit.io.guarded.documents import read_json
from toolkit.io.length_names import LengthNames
from toolkit.io.splat_placement import origin_comment
from toolkit.runs.evaluation.frame_states import FrameState, PartSummary
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.folder import RunFolder
from toolkit.runs.formats import FolderVersion, folder_version, upgraded
from toolkit.runs.frame_records import read_part, read_state
from toolkit.runs.recording_samples import is_same_recording
from toolkit.runs.recordings import open_recording
from toolkit.runs.settings import RunSettings, load_stored_settings
from toolkit.semantics.factory import build_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.semantic_mapping import SemanticMapping, build_semantic_mapping
from toolkit.slam.submaps.store import SavedSubmaps, SubmapStore
from toolkit.splatting.gaussians.cloud import GaussianCloud


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        folder: the run folder.
        settings: settings of the run.
        gaussians: the map.
        tracked: all frames with a pose in the main part of the map, in order.
        lost: indices of the frames without a pose.
        keyframes: frame indices of the keyframes.
        semantics: decoder of the features; without channels for a map without semantics.
        taxonomy: taxonomy of the labels, or None.
        anchors: T_world_submap [4, 4] of each readable submap of the main part, by number.
        camera: intrinsics of the frames after resizing.
        dataset_from_run: path of the dataset relative to the run folder, or None.
        samples: small images of the dataset (`recording_samples`).
        estimates: what the run has estimated of the recording; None for runs that did not store it.
        states: states of all frames of the sequence, in order.
        parts: parts of the map, the main part first; the relative poses of parts are unknown.
        metric: whether lengths are in metres; otherwise their unit is arbitrary.
        up_side: the side of the images that is up.
        origin_m: [3] position of the map's origin in the coordinates of the given poses; 0 unless
            these are far away.
        version: version of the folder, which may be older than this one.
    """

    folder: RunFolder
    settings: RunSettings
    gaussians: GaussianCloud
    tracked: list[TrackedFrame]
    lost: list[int]
    keyframes: list[int]
    semantics: SemanticMapping
    taxonomy: Taxonomy | None
    anchors: dict[int, NDArray[np.float64]]
    camera: Camera
    dataset_from_run: str | None
    samples: list[dict[str, Any]]
    estimates: RecordingEstimates | None
    states: list[FrameState]
    parts: list[PartSummary]
    metric: bool
    up_side: ImageSide
    origin_m: NDArray[np.float64]
    version: FolderVersion

    @property
    def submaps(self) -> SavedSubmaps:
        """The submaps in their final state.

        Raises:
            RunFolderError: the run stored no submaps, or one is missing.
        """
        store = SubmapStore.newest(self.folder.submaps, self.settings.submaps.memory_mb)
        if not self.anchors or not all(number in store for number in self.anchors):
            raise RunFolderError(f"submaps are missing in {self.folder.submaps}; run again")
        return SavedSubmaps(store, self.anchors)

    @property
    def trajectory(self) -> Trajectory:
        """Poses T_map_camera of the tracked frames in the frame of the map."""
        times = np.array([frame.timestamp_s for frame in self.tracked])
        poses = np.array([frame.T_map_camera for frame in self.tracked]).reshape(-1, 4, 4)
        return Trajectory(times, poses)

    @property
    def length_names(self) -> LengthNames:
        """How lengths of the map are written."""
        return LengthNames(self.metric)

    @property
    def descriptor_remedy(self) -> str:
        """What to do about keyframes without descriptors for place recognition."""
        if self.settings.loops.use:
            return (
                "runs with --depth none or --poses given compute none; run SLAM again with depth "
                "and tracked poses"
            )
        return "run SLAM again with --loops.use"

    @property
    def map_comments(self) -> tuple[str, ...]:
        """Comments of a file of the map: its origin unless it is 0, and what its lengths are."""
        return (*origin_comment(self.origin_m), *self.length_names.notes)

    @property
    def T_given_map(self) -> NDArray[np.float64]:
        """[4, 4] translation from the map to the coordinates of the given poses."""
        return se3.from_rotation_translation(np.eye(3), self.origin_m)

    def separate_trajectories(self) -> dict[int, Trajectory]:
        """Poses of the frames of each separate part in the part's frame, by number.

        Raises:
            FormatError: a file is missing or damaged.
        """
        return {
            part.number: self.folder.part(part.number).read_trajectory()
            for part in self.parts
            if part.number > 0 and part.frames
        }

    @property
    def dataset_path(self) -> Path | None:
        """Folder of the dataset.

        If its absolute path does not exist, its path relative to the run folder is used: both
        may have been moved together.
        """
        path = self.settings.dataset.path
        if path is not None and not path.exists() and self.dataset_from_run is not None:
            moved = (self.folder.path / self.dataset_from_run).resolve()
            return moved if moved.exists() else path
        return path

    def open_dataset(
        self, path: str | os.PathLike[str] | None = None, image_size: tuple[int, int] | None = None
    ) -> RecordedDataset:
        """Open the dataset of the run.

        Args:
            path: folder of the dataset, if it was moved.
            image_size: width and height in pixels; by default as in the run.

        Raises:
            DatasetError: it does not exist, has changed or is another one.
        """
        path = path or self.dataset_path
        if path is None:
            raise DatasetError(f"{self.folder.config} has no dataset.path; add it to the file")
        dataset = open_recording(self.settings, path, image_size, self.estimates)
        if not is_same_recording(dataset, self.samples):
            raise DatasetError(
                f"{path} is not the recording of {self.folder.path}: its images differ from those "
                f"of the run; give the folder that holds them (config.yaml says dataset.path "
                f"{self.settings.dataset.path})"
            )
        if not dataset.recording.calibrated and self.camera.size == dataset.camera.size:
            dataset.camera = self.camera  # the focal length that the run has estimated
        return dataset


def load_run(path: str | os.PathLike[str]) -> FinishedRun:
    """Load the settings, map and poses of a finished run.

    Args:
        path: the run folder.

    Raises:
        ToolkitError: the folder contains no run, the run is not finished, or a file is damaged.
    """
    path = Path(path)
    folder = RunFolder.open(path)
    for file in (folder.map, folder.trajectory, folder.frames):
        if file.is_file():
            continue
        if folder.metrics.is_file():
            raise RunFolderError(
                f"{path} has no {file.name}: the run ended without a map, or the file was removed; "
                f"see {folder.log}"
            )
        raise RunFolderError(
            f"{path} has no {file.name}: the run is not finished; "
            "repeat its semsplat run command with --resume"
        )
    content, settings, version = _described(folder)
    taxonomy = folder.read_taxonomy()
    code = None if taxonomy is None else build_code(settings.semantics.code, taxonomy)
    semantics = build_semantic_mapping(settings.semantics, code, settings.seed)
    semantics.restore(folder.read_semantics())
    gaussians = folder.read_map()
    if gaussians.features.shape[1] != semantics.channels:
        raise RunFolderError(
            f"{folder.semantics} has {gaussians.features.shape[1]} channels, but the code of "
            f"{folder.config} has {semantics.channels}; run again"
        )
    try:
        return FinishedRun(
            folder=folder,
            settings=settings,
            semantics=semantics,
            taxonomy=taxonomy,
            gaussians=gaussians,
            tracked=_tracked(content["frames"], folder.read_trajectory().T_world_camera),
            lost=[int(i) for i in content["lost"]],
            keyframes=[int(i) for i in content["keyframes"]],
            anchors=_anchors(content["submaps"]),
            camera=Camera(**content["camera"]),
            dataset_from_run=content.get("dataset_from_run"),
            samples=content.get("samples", []),
            estimates=_estimates(content.get("recording")),
            states=[read_state(row) for row in content["states"]],
            parts=[read_part(row) for row in content["parts"]],
            metric=bool(content["metric"]),
            up_side=_side(content.get("up", "top")),
            origin_m=np.array(content.get("origin_m", [0, 0, 0]), np.float64).reshape(3),
            version=version,
        )
    except (KeyError, TypeError, ValueError, SettingsError) as error:
        raise _damaged(folder, error) from error


def _described(folder: RunFolder) -> tuple[dict[str, Any], RunSettings, FolderVersion]:
    """The content of frames.json in the current format, the settings, and the folder's version."""
    content = _read_frames(folder.frames)
    settings, ignored = load_stored_settings(folder.config)
    try:
        version = folder_version(content, ignored)
        content = upgraded(content, version, settings)
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(folder, error) from error
    version.log(folder.path)
    return content, settings, version


def _damaged(folder: RunFolder, error: Exception) -> RunFolderError:
    return RunFolderError(f"{folder.frames} is damaged ({error!r}); run again")


def _read_frames(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path)
    except ValueError as error:
        raise RunFolderError(f"{path} is not JSON ({error}); run again") from error
    if not isinstance(content, dict):
        raise RunFolderError(f"{path} does not contain a dictionary; run again")
    return content


def _estimates(values: dict[str, Any] | None) -> RecordingEstimates | None:
    return None if values is None else RecordingEstimates.from_json(values)


def _side(name: str) -> ImageSide:
    if name not in SIDES:
        raise ValueError(f"{name} is not a side of an image")
    return name


def _anchors(rows: list[dict[str, Any]]) -> dict[int, NDArray[np.float64]]:
    anchors = {
        int(row["number"]): np.array(row["T_world_submap"], np.float64).reshape(4, 4)
        for row in rows
        if not row["lost"] and row["part"] == 0
    }
    if not all(se3.is_rigid(T) for T in anchors.values()):
        raise ValueError("the pose of a submap is not rigid")
    return anchors


def _tracked(rows: list[dict[str, Any]], poses: NDArray[np.float64]) -> list[TrackedFrame]:
    if len(rows) != len(poses):
        raise ValueError(f"{len(rows)} frames, but trajectory.txt has {len(poses)} poses")
    tracked = [
        TrackedFrame(
            index=int(row["index"]),
            timestamp_s=float(row["timestamp_s"]),
            T_map_camera=T_map_camera,
            exposure=Exposure.from_values(row),
            held_out=bool(row["held_out"]),
        )
        for row, T_map_camera in zip(rows, poses, strict=True)
    ]
    for frame in tracked:
        exposure = frame.exposure
        numbers = (frame.timestamp_s, exposure.gain, exposure.bias, *exposure.balance)
        if frame.index < 0 or not np.isfinite(numbers).all():
            raise ValueError(f"the values of frame {frame.index} are out of range")
    return tracked
