"""ScanNet as frames exported from its .sens files (data_tools/export_sens.py)."""

from __future__ import annotations

from pathlib import Path

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import Recording
from toolkit.datasets.pairing import (
    Truth,
    attach_poses,
    camera_of_matrix,
    folder_holding,
    numbered,
    pair_numbered,
    pairing_flaws,
)
from toolkit.io.class_names import read_class_names
from toolkit.io.images import read_depth_m, read_rgb
from toolkit.io.trajectories import read_matrix

FPS = 30.0
DEPTH_SCALE = 1000.0


def describe(path: Path) -> Recording:
    """Describe `color/N.jpg`, `depth/N.png`, `pose/N.txt`, `intrinsic/intrinsic_depth.txt`.

    Without the matrix of the depth camera, `intrinsic/intrinsic_color.txt` is scaled to the depth
    image, which ScanNet registers to colour. Colour images are resized to the depth images.
    Non-finite poses are omitted from the ground truth. `labels/N.png` with
    `labels/classes.json` are optional.

    Raises:
        DatasetError: the folder has a different layout.
        FormatError: the file of a pose or of the intrinsics does not contain a matrix.
    """
    folder = folder_holding(path, ("color", "depth"), "ScanNet")
    rgb = numbered(folder / "color", r"(\d+)\.(?:jpg|png)")
    depth = numbered(folder / "depth", r"(\d+)\.png")
    labels = numbered(folder / "labels", r"(\d+)\.png")
    pose_files = numbered(folder / "pose", r"(\d+)\.txt")
    files = pair_numbered(rgb, depth, labels, FPS)
    if not files:
        raise DatasetError(
            f"{folder} contains no color/N.jpg with depth/N.png; export the frames again"
        )
    poses = [read_matrix(pose_files[n]) if n in pose_files else None for n in rgb if n in depth]
    truth = attach_poses(files, poses) if pose_files else Truth(None)
    return Recording(
        name=folder.resolve().name,
        camera=_camera(folder, files[0].rgb, next(iter(depth.values()))),
        files=files,
        depth_scale=DEPTH_SCALE,
        ground_truth=truth.trajectory,
        label_names=read_class_names(folder / "labels" / "classes.json") if labels else None,
        colour_may_be_larger=True,
        flaws=pairing_flaws(rgb, depth, labels) + truth.missing + truth.not_rigid,
        notes=truth.infinite,
    )


def _camera(folder: Path, rgb_file: Path, depth_file: Path) -> Camera:
    """Return the camera of the depth images."""
    height, width = read_depth_m(depth_file, DEPTH_SCALE).shape
    own, colours = (
        folder / "intrinsic" / name for name in ("intrinsic_depth.txt", "intrinsic_color.txt")
    )
    file = own if own.exists() else colours
    if not file.exists():
        raise DatasetError(
            f"{folder} has no intrinsic/intrinsic_depth.txt nor intrinsic_color.txt; export "
            f"the .sens file again (data_tools/export_sens.py)"
        )
    if file == own:
        return camera_of_matrix(own, width, height)
    colour_height, colour_width = read_rgb(rgb_file).shape[:2]
    colour = camera_of_matrix(colours, colour_width, colour_height)
    return colour.scaled(width / colour_width, height / colour_height, width, height)
