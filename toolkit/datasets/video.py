"""A film as it comes from a phone or camera: colour without depth or intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.folder import read_intrinsics
from toolkit.errors import DatasetError
from toolkit.geometry.camera import Camera
from toolkit.io.video import VideoFile

# Focal length relative to the longer side of the image, where nothing else is known: that of a
# phone's main camera, 28 mm on 35 mm film.
TYPICAL_FOCAL = 28.0 / 36.0
# Relative standard deviation of a focal length that metadata states. Equivalents on 35 mm film are
# rounded to 1 mm, which is 2 % of a phone's 26 mm, and autofocus changes the focal length.
FOCAL_SIGMA = 0.03


def describe(path: Path) -> Recording:
    """Describe a film and, beside it, an optional file of its name with suffix `.yaml`.

    The file has the keys of `intrinsics.yaml` in the `folder` layout. Without it, the focal length
    is a typical one and is to be estimated. Timestamps are those of the film, also where its frame
    rate varies; rotation metadata is applied.

    Raises:
        DatasetError: the film cannot be read, or the intrinsics are malformed or for another size.
    """
    if path.is_dir():
        raise DatasetError(f"{path} is a folder; specify the film, for instance film.mp4")
    video = VideoFile(path)
    height, width = video.rgb(0).shape[:2]
    times = video.timestamps_s()
    files = tuple(FrameFiles(t, path, None, number=n) for n, t in times.items())
    calibration = path.with_suffix(".yaml")
    if calibration.exists():
        intrinsics = read_intrinsics(calibration, has_depth=False)
        if intrinsics.camera.size != (width, height):
            raise DatasetError(
                f"{calibration} is for {intrinsics.camera.width}x{intrinsics.camera.height} pixels "
                f"but {path.name} has {width}x{height}; correct the file"
            )
        return Recording(
            path.stem,
            intrinsics.camera,
            files,
            1.0,
            distortion=intrinsics.distortion,
            fisheye=intrinsics.fisheye,
        )
    return Recording(
        path.stem,
        typical_camera(width, height),
        files,
        1.0,
        notes=(f"no intrinsics in {calibration.name}; the focal length is estimated",),
        calibrated=False,
    )


def typical_camera(width: int, height: int) -> Camera:
    """Camera with the focal length of a phone's main camera."""
    return camera_with_focal(width, height, TYPICAL_FOCAL * max(width, height))


def camera_with_focal(width: int, height: int, focal_px: float) -> Camera:
    """Camera with square pixels whose principal point is the centre of the image."""
    return Camera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)


def camera_with_fov(camera: Camera, fov_deg: float) -> Camera:
    """The camera with a horizontal field of view in degrees and square pixels."""
    focal = 0.5 * camera.width / float(np.tan(np.radians(fov_deg) / 2))
    return Camera(focal, focal, camera.cx, camera.cy, camera.width, camera.height)
