"""Export images with poses: models of COLMAP and `transforms.json` of nerfstudio."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from toolkit.base.errors import SettingsError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import RecordedDataset
from toolkit.exports.selection import SelectedGaussians
from toolkit.io.atomic import cannot_write
from toolkit.io.images import write_png
from toolkit.io.labelled_points import LabelledPoints, write_labelled_points
from toolkit.io.posed_images import (
    ColouredPoints,
    PosedImage,
    write_colmap_binary,
    write_colmap_text,
    write_transforms,
)
from toolkit.io.visualisation import RgbImage, colour_image
from toolkit.runs.evaluation.run_metrics import TrackedFrame
from toolkit.runs.maps.finished import FinishedRun
from toolkit.splatting.rendering import backend, render_surface

ImagePolicy = Literal["copy", "render", "reference"]

_IMAGES, _SPARSE, _POINTS = "images", Path("sparse") / "0", "points.ply"


@dataclass(frozen=True)
class ViewExportOptions:
    """Options of the export of views.

    Attributes:
        images: "copy" writes the recorded images as the run used them (undistorted, resized),
            "render" images of the map, "reference" names the files of the dataset.
        every: interval of the frames, >= 1.
        max_points: maximum number of points, >= 1.
    """

    images: ImagePolicy
    every: int
    max_points: int


def export_colmap(
    folder: Path, selection: SelectedGaussians, options: ViewExportOptions, binary: bool
) -> int:
    """Write a COLMAP model to `sparse/0` and the images to `images`.

    Referenced images are named relative to the folder of the dataset.

    Returns:
        The number of images.

    Raises:
        ToolkitError: there are no frames, an image cannot be read or referenced, or the folder
            cannot be written.
    """
    frames = _frames(selection.run, options.every)
    root = selection.run.dataset_path
    names = _write_images(folder, selection, frames, options.images, root or folder)
    posed = _posed(selection.run, names, frames)
    write = write_colmap_binary if binary else write_colmap_text
    model = _created(folder / _SPARSE)
    write(model, selection.run.camera, posed, _points(selection, options.max_points))
    return len(posed)


def export_nerfstudio(
    folder: Path, selection: SelectedGaussians, options: ViewExportOptions
) -> int:
    """Write `transforms.json`, the images to `images`, and points for initialisation.

    Returns:
        The number of images.

    Raises:
        ToolkitError: as for `export_colmap`.
    """
    frames = _frames(selection.run, options.every)
    names = _write_images(folder, selection, frames, options.images, None)
    local = options.images != "reference"
    paths = [f"{_IMAGES}/{name}" if local else name for name in names]
    posed = _posed(selection.run, paths, frames)
    points = _points(selection, options.max_points)
    write_labelled_points(folder / _POINTS, LabelledPoints(points.points_m, points.rgb, None, {}))
    write_transforms(folder / "transforms.json", selection.run.camera, posed, _POINTS)
    return len(posed)


def _frames(run: FinishedRun, every: int) -> list[TrackedFrame]:
    if not run.tracked:
        raise ToolkitError(
            f"{run.folder.path} has no frame with a pose; there is nothing to export"
        )
    return run.tracked[::every]


def _posed(
    run: FinishedRun, names: Sequence[str], frames: Sequence[TrackedFrame]
) -> list[PosedImage]:
    return [
        PosedImage(name, run.T_given_map @ frame.T_map_camera)
        for name, frame in zip(names, frames, strict=True)
    ]


def _points(selection: SelectedGaussians, max_points: int) -> ColouredPoints:
    """Return centres of opaque Gaussians, evenly thinned to the maximum number."""
    opaque = selection.opaque()
    count = min(max_points, len(opaque.gaussians))
    index = np.linspace(0, len(opaque.gaussians) - 1, count).round().astype(int)
    return ColouredPoints(opaque.given_m[index], opaque.rgb[index])


def _write_images(
    folder: Path,
    selection: SelectedGaussians,
    frames: Sequence[TrackedFrame],
    policy: ImagePolicy,
    root: Path | None,
) -> list[str]:
    """Write or reference the images and return their names."""
    run = selection.run
    dataset = None if policy == "render" else run.open_dataset()
    if dataset is not None and policy == "reference":
        _created(folder)
        return [_reference(dataset, run.camera, frame.index, root) for frame in frames]
    out = _created(folder / _IMAGES)
    names = [f"frame_{frame.index:06d}.png" for frame in frames]
    for frame, name in zip(frames, names, strict=True):
        image = (
            _rendered(selection, frame)
            if dataset is None
            else colour_image(dataset[frame.index].rgb)
        )
        write_png(out / name, image)
    return names


def _rendered(selection: SelectedGaussians, frame: TrackedFrame) -> RgbImage:
    renderer = backend(selection.run.settings.backend)
    T_camera_map = se3.inverse(frame.T_map_camera)
    surface = render_surface(renderer, selection.gaussians, selection.run.camera, T_camera_map)
    return colour_image(surface.output.colour.numpy())


def _reference(dataset: RecordedDataset, camera: Camera, index: int, root: Path | None) -> str:
    """Return the path of an image file of the dataset: relative to `root`, or absolute."""
    recording, files = dataset.recording, dataset.files(index)
    changed = (
        recording.distortion is not None
        or recording.camera != camera
        or recording.colour_may_be_larger
        or files.number is not None
        or files.orientation != 1
    )
    if changed:
        raise SettingsError(
            f"--images reference: {files.rgb} differs from the image that the run used "
            "(undistorted, resized, or a frame of a video); use --images copy"
        )
    path = files.rgb.resolve()
    return str(path) if root is None else os.path.relpath(path, root.resolve())


def _created(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
    return folder
