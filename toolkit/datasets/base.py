"""Dataset interface, and the class that loads frames from files.

The module of a format only describes a recording: files, timestamps and camera. Loading,
undistortion and resizing are implemented here for all formats.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from toolkit.base.caching import ImageStore
from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame, without_pixels
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.datasets.orientation import oriented
from toolkit.datasets.prefetch import prefetched
from toolkit.datasets.resize import ImageGrid, enlarge_depth, enlarge_mask, resize_colour
from toolkit.datasets.sparse_depth import filled
from toolkit.datasets.undistortion import Undistortion
from toolkit.io import images
from toolkit.io.guarded.images import MAX_PIXELS
from toolkit.io.video import VideoFile

# Images of as many pixels are decoded to compare their size with the camera's; colour has up to
# this multiple of the pixels of depth.
_ANY_PIXELS, _LARGER = 2**22, 400


class Dataset(Protocol):
    """A sequence of RGB-D frames that are loaded on access.

    Attributes:
        name: short name for reports.
        camera: intrinsics of all frames, after resizing.
        ground_truth: camera-to-world poses at the timestamps of the frames that have ground
            truth, or None if there is none.
        label_names: class names by id, or None without labels.
    """

    name: str
    camera: Camera
    ground_truth: Trajectory | None
    label_names: dict[int, str] | None

    def __len__(self) -> int: ...

    def __getitem__(self, index: int) -> Frame: ...

    def __iter__(self) -> Iterator[Frame]: ...


class Container(Protocol):
    """A file that contains the images of all frames, for instance a bag."""

    def rgb(self, number: int) -> NDArray[np.float32]:
        """Colour image [H, W, 3] of frame `number`, RGB in [0, 1]."""

    def depth_m(self, number: int) -> NDArray[np.float32]:
        """Depth image [H, W] of frame `number` in metres, 0 where missing."""


@dataclass(frozen=True)
class FrameFiles:
    """The files of one frame.

    Attributes:
        timestamp_s: seconds, strictly increasing.
        rgb: colour image, or the video or other file that contains it.
        depth: depth image, or the file that contains it, or None without depth.
        labels: image of class ids, or None.
        number: number of the frame in the file `rgb`; None if `rgb` is an image.
        orientation: of the colour image, as in EXIF; 1 if the pixels are stored as shown.
        confidence: image of the depth's confidence, where depth with 0 is missing, or None.
    """

    timestamp_s: float
    rgb: Path
    depth: Path | None
    labels: Path | None = None
    number: int | None = None
    confidence: Path | None = None
    orientation: int = 1

    @property
    def stem(self) -> str:
        """Name for files that belong to the frame, without suffix."""
        return self.rgb.stem if self.number is None else f"{self.number:06d}"

    @property
    def name(self) -> str:
        """Name of the colour image in messages."""
        if self.number is None:
            return self.rgb.name
        return f"{self.rgb.name} frame {self.number}"


@dataclass(frozen=True)
class Recording:
    """Description of a recording; images are not loaded yet.

    Attributes:
        name: short name for reports.
        camera: intrinsics of the image files.
        files: one entry per frame, with strictly increasing timestamps.
        depth_scale: depth image values per metre.
        ground_truth: poses at the timestamps of the frames, or None.
        label_names: class names by id, or None.
        missing_from_m: depth (m) from which on it means that nothing was measured.
        gap_px: standard deviation in pixels of the window in which gaps of sparse depth are filled;
            0 for dense depth.
        distortion: OpenCV's (k1, k2, p1, p2, k3[, k4, k5, k6]) of both images, or None.
        fisheye: whether `distortion` is (k1, k2, k3, k4) of the model of Kannala and Brandt.
        colour_may_be_larger: whether colour images are resized to the size of the depth images.
        colour_camera: intrinsics of these larger colour images, for use without depth.
        rotated: whether rotation metadata of a video is applied.
        container: reads the images of frames with a `number`; None if they are a video's.
        depth_fault: why the depth of the recording cannot be used, if it has any.
        flaws: one line for each defect of the recording that was worked around.
        notes: one line for each kind of gap that is common in this format.
        calibrated: whether the focal length is known; otherwise it is to be estimated.
        focal_sigma: relative standard deviation of a focal length from metadata; None without one,
            so that a typical focal length is the initial value.
        depth_offset_px: (x, y) by which colour images are offset from depth images; depth is
            shifted by it.
        readout_s: time in seconds from the exposure of the first row of an image to that of the
            last, of colour and depth; 0 for a global shutter; None if it is not known.
        readout_sigma_s: its standard deviation, if it was estimated.
        up_world: (x, y, z) of the direction up in the coordinates of the poses, where the device
            measures gravity; None where it is not known.
        carrier: [h, w] bool, parts of the image that show what carries the camera and are ignored;
            None for none.
        kept: images that several checks read, shared by changed copies of the recording.
    """

    name: str
    camera: Camera
    files: tuple[FrameFiles, ...]
    depth_scale: float
    ground_truth: Trajectory | None = None
    label_names: dict[int, str] | None = None
    missing_from_m: float = float("inf")
    gap_px: float = 0.0
    distortion: tuple[float, ...] | None = None
    fisheye: bool = False
    colour_may_be_larger: bool = False
    colour_camera: Camera | None = None
    rotated: bool = True
    container: Container | None = None
    depth_fault: str | None = None
    flaws: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    calibrated: bool = True
    focal_sigma: float | None = None
    depth_offset_px: tuple[float, float] = (0.0, 0.0)
    readout_s: float | None = None
    readout_sigma_s: float = 0.0
    up_world: tuple[float, float, float] | None = None
    carrier: NDArray[np.bool_] | None = None
    kept: ImageStore = field(default_factory=lambda: ImageStore(_KEPT), compare=False, repr=False)


# Bytes of 16 frames with 640x480 pixels.
_KEPT = 80_000_000
# Poses farther away than this lose millimetres in single precision; they become relative.
_FAR_M = 1000.0


class RecordedDataset:
    """Dataset of a recording; frames are loaded on access and resized.

    Attributes:
        origin_m: [3] position in the recording's coordinates, of which those of `ground_truth` are
            relative; whole metres, and 0 unless its poses are far away, as in UTM.
        readout_s: time in seconds from the exposure of the first row of a frame to that of the
            last; 0 for a global shutter, or if it is not known.
        readout_sigma_s: its standard deviation.

    Args:
        recording: description of the files.
        image_size: (width, height) in pixels, or None for the native size.
        max_frames: maximum number of frames from the start, >= 1, or None for all.

    Raises:
        DatasetError: there are no frames, or `image_size` or `max_frames` is not positive.
    """

    def __init__(
        self,
        recording: Recording,
        image_size: tuple[int, int] | None = None,
        max_frames: int | None = None,
    ) -> None:
        if max_frames is not None and max_frames < 1:
            raise DatasetError(f"max_frames must be at least 1, got {max_frames}")
        if not recording.files:
            raise DatasetError(f"{recording.name} contains no frames; check the path and layout")
        self.recording = recording
        self.name = recording.name
        self.label_names = recording.label_names
        self.stems = [files.stem for files in recording.files[:max_frames]]
        self._files = recording.files[:max_frames]
        self._undistortion = (
            Undistortion(recording.camera, recording.distortion, recording.fisheye)
            if recording.distortion
            else None
        )
        # Images of another size than the camera's are refused, but not decoded if they are huge.
        pixels = recording.camera.width * recording.camera.height
        factor = _LARGER if recording.colour_may_be_larger else 1
        self._max_pixels = min(MAX_PIXELS, max(_ANY_PIXELS, factor * pixels))
        offset_px = recording.depth_offset_px
        size = image_size or (recording.camera.size if any(offset_px) else None)
        self._grid = ImageGrid(recording.camera, size, offset_px) if size else None
        self.camera = self._grid.camera if self._grid else recording.camera
        self._ignored: NDArray[np.bool_] | None = None
        if recording.carrier is not None:
            carrier = enlarge_mask(recording.carrier, recording.camera.size)
            self._ignored = self._grid.nearest(carrier) if self._grid else carrier
        # A crop contains a part of the rows.
        rows = self.camera.height / self.camera.fy * recording.camera.fy / recording.camera.height
        self.readout_s = (recording.readout_s or 0.0) * rows
        self.readout_sigma_s = recording.readout_sigma_s * rows
        self._videos: dict[Path, VideoFile] = {}
        self.origin_m = np.zeros(3)
        self.ground_truth: Trajectory | None = None
        self.use_poses(recording.ground_truth)

    def use_poses(self, trajectory: Trajectory | None) -> None:
        """Take poses as ground truth, relative to an origin if they are far away.

        Args:
            trajectory: in the recording's coordinates.
        """
        truth = _truth_until(trajectory, self._files[-1].timestamp_s)
        if truth is not None and len(truth) and np.abs(truth.positions_m).max() > _FAR_M:
            self.origin_m = np.floor(truth.positions_m[0])
            truth = truth.transformed(se3.from_rotation_translation(np.eye(3), -self.origin_m))
        self.ground_truth = truth

    def use_camera(self, camera: Camera) -> None:
        """Take estimated intrinsics of the resized images, where a recording has none."""
        self.camera = camera

    def __len__(self) -> int:
        return len(self._files)

    @property
    def timestamps_s(self) -> NDArray[np.float64]:
        """Timestamps [N] of the frames in seconds."""
        return np.array([files.timestamp_s for files in self._files])

    def files(self, index: int) -> FrameFiles:
        """Return the files of frame `index`."""
        return self._files[index]

    def __getitem__(self, index: int) -> Frame:
        """Load frame `index`, 0 <= index < len.

        Raises:
            IndexError: there is no such frame.
            DatasetError: one of its files is missing, corrupt or of the wrong size.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {len(self)} in {self.name}")
        files = self._files[index]
        return self._frame(index, self._load(files), self._labels(files))

    def sample(self, index: int, keep: bool) -> Frame:
        """Load frame `index` for a check, from images that an earlier check has kept.

        Args:
            keep: whether the images are kept for others; the frame has no labels then.

        Raises:
            DatasetError: one of its files is missing, corrupt or of the wrong size.
        """
        files, recording = self._files[index], self.recording
        depth = recording.depth_scale, recording.missing_from_m, recording.gap_px
        key = files, depth, recording.camera, recording.distortion
        native = recording.kept.get(key, lambda: self._load(files), keep)
        return self._frame(index, native, None if keep else self._labels(files))

    def _frame(self, index: int, native: tuple[NDArray, ...], labels: NDArray | None) -> Frame:
        """A frame of colour and depth, and labels, at the native size."""
        rgb, depth_m = native
        if self._grid:
            rgb = self._grid.colour(rgb)
            depth_m = self._grid.depth(depth_m)
            labels = None if labels is None else self._grid.nearest(labels)
        frame = Frame(
            index,
            self._files[index].timestamp_s,
            rgb,
            depth_m,
            self.camera,
            labels,
            readout_s=self.readout_s,
            readout_sigma_s=self.readout_sigma_s,
        )
        return frame if self._ignored is None else without_pixels(frame, self._ignored)

    def __iter__(self) -> Iterator[Frame]:
        """Iterate over all frames in order, prefetched by a background thread."""
        return prefetched(self, range(len(self)))

    def _load(self, files: FrameFiles) -> tuple[NDArray, NDArray]:
        """Load colour and depth at the native size, without distortion."""
        recording = self.recording
        depth_m = self._depth_m(files)
        rgb = self._colour(files)
        if recording.colour_may_be_larger and rgb.shape[:2] != depth_m.shape:
            rgb = resize_colour(rgb, recording.camera.size)
        check_size(rgb, recording.camera.size, files.rgb)
        if self._undistortion:
            return self._undistortion.colour(rgb), self._undistortion.nearest(depth_m)
        return rgb, depth_m

    def _labels(self, files: FrameFiles) -> NDArray[np.int32] | None:
        if files.labels is None:
            return None
        labels = images.read_labels(files.labels, self._max_pixels)
        check_size(labels, self.recording.camera.size, files.labels)
        return self._undistortion.nearest(labels) if self._undistortion else labels

    def _depth_m(self, files: FrameFiles) -> NDArray[np.float32]:
        recording = self.recording
        if files.depth is None:
            return np.zeros((recording.camera.height, recording.camera.width), np.float32)
        if recording.container is not None and files.number is not None:
            depth_m = recording.container.depth_m(files.number)
        else:
            depth_m = images.read_depth_m(files.depth, recording.depth_scale, self._max_pixels)
        # Not finite, or negative: containers have floating-point depth.
        depth_m = np.where((depth_m > 0.0) & (depth_m < recording.missing_from_m), depth_m, 0.0)
        if files.confidence is not None:
            confidence = images.read_labels(files.confidence, self._max_pixels)
            height, width = depth_m.shape
            check_size(confidence, (width, height), files.confidence)
            depth_m[confidence == 0] = 0.0
        if recording.gap_px:
            depth_m = filled(depth_m, recording.gap_px)
        if recording.camera == recording.colour_camera:
            depth_m = enlarge_depth(depth_m, recording.camera.size)
        check_size(depth_m, recording.camera.size, files.depth)
        return depth_m

    def _colour(self, files: FrameFiles) -> NDArray[np.float32]:
        if files.number is None:
            return oriented(images.read_rgb(files.rgb, self._max_pixels), files.orientation)
        if self.recording.container is not None:
            return self.recording.container.rgb(files.number)
        if files.rgb not in self._videos:
            self._videos[files.rgb] = VideoFile(files.rgb, self.recording.rotated)
        return self._videos[files.rgb].rgb(files.number)


def check_size(image: NDArray, size: tuple[int, int], path: Path) -> None:
    """Check that an image [H, W, ...] of a file has the (width, height) of the camera.

    Raises:
        DatasetError: it has not.
    """
    height, width = image.shape[:2]
    if (width, height) != size:
        raise DatasetError(
            f"{path} is {width}x{height} but the camera of this dataset is {size[0]}x{size[1]}; "
            f"colour, depth and intrinsics must have the same size"
        )


def _truth_until(trajectory: Trajectory | None, last_s: float) -> Trajectory | None:
    if trajectory is None:
        return None
    kept = trajectory.timestamps_s <= last_s
    return Trajectory(trajectory.timestamps_s[kept], trajectory.T_world_camera[kept])
