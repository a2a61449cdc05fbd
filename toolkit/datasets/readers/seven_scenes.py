"""7-Scenes: a sequence folder with colour, depth and pose files."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import Recording
from toolkit.datasets.pairing import (
    Truth,
    attach_poses,
    camera_of_matrix,
    numbered,
    pair_numbered,
    pairing_flaws,
)
from toolkit.io.images import read_rgb
from toolkit.io.trajectories import read_matrix
from toolkit.io.user_files import visible

FPS = 30.0
DEPTH_SCALE = 1000.0
_STANDARD_FOCAL = 585.0

_log = logging.getLogger(__name__)


def describe(path: Path) -> Recording:
    """Describe `frame-N.color.png|jpg`, `frame-N.depth.png`, `frame-N.pose.txt`.

    The camera is read from `camera-intrinsics.txt` (a 3x3 matrix). Without that file the standard
    focal length of 585 pixels is used, with a warning. Depth values 0 and 65535 are missing.

    Raises:
        DatasetError: the folder has a different layout.
        FormatError: the file of the intrinsics does not contain a matrix.
    """
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; specify the folder of a 7-Scenes sequence")
    folder = _sequence_folder(path)
    rgb = numbered(folder, r"frame-(\d+)\.color\.(?:png|jpg)")
    depth = numbered(folder, r"frame-(\d+)\.depth\.png")
    pose_files = numbered(folder, r"frame-(\d+)\.pose\.txt")
    files = pair_numbered(rgb, depth, {}, FPS)
    if not files:
        raise DatasetError(
            f"{folder} contains no frame-N.color.png (or .jpg) with frame-N.depth.png; "
            f"check the path and the kind of the dataset"
        )
    flaws = pairing_flaws(rgb, depth, {})
    height, width = read_rgb(files[0].rgb).shape[:2]
    try:
        camera = _camera(folder, width, height)
    except SettingsError as error:
        raise DatasetError(f"{files[0].rgb}: {error}; export the images again") from error
    poses = [_pose(pose_files.get(n)) for n in rgb if n in depth]
    truth = attach_poses(files, poses) if pose_files else Truth(None)
    return Recording(
        name=folder.resolve().name,
        camera=camera,
        files=files,
        depth_scale=DEPTH_SCALE,
        ground_truth=truth.trajectory,
        flaws=flaws + truth.flaws,
    )


def _sequence_folder(path: Path) -> Path:
    """Return `path`, or its only child folder with frames."""
    if any(path.glob("frame-*.color.*")):
        return path
    children = [c for c in visible(path) if c.is_dir() and any(c.glob("frame-*.color.*"))]
    if len(children) > 1:
        raise DatasetError(
            f"{path} contains {len(children)} sequences; specify the path of one, for example "
            f"{children[0]}"
        )
    return children[0] if children else path


def _camera(folder: Path, width: int, height: int) -> Camera:
    file = folder / "camera-intrinsics.txt"
    if not file.exists():
        _log.warning(
            "%s has no camera-intrinsics.txt: using the standard focal length of 7-Scenes, %g px",
            folder,
            _STANDARD_FOCAL,
        )
        return Camera(_STANDARD_FOCAL, _STANDARD_FOCAL, width / 2, height / 2, width, height)
    return camera_of_matrix(file, width, height)


def _pose(file: Path | None) -> NDArray[np.float64] | None:
    return None if file is None else read_matrix(file)
