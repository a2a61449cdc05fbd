"""A film as it comes from a phone or camera: colour without depth or intrinsics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.readers.folder import read_intrinsics
from toolkit.io.exif import focal_of_equivalent
from toolkit.io.quicktime import EQUIVALENT_FOCAL_MM, read_metadata
from toolkit.io.video import VideoFile

# Focal length relative to the longer side of the image, where nothing else is known: that of a
# phone's main camera, 28 mm on 35 mm film.
TYPICAL_FOCAL = 28.0 / 36.0
# Relative standard deviation of a focal length from metadata. Equivalents on 35 mm film are rounded
# to 1 mm, which is 2 % of a phone's 26 mm, and autofocus changes the focal length.
FOCAL_SIGMA = 0.03
# Factor by which stabilisation enlarges films, and the uncertainty of their focal length. Without
# stabilisation it is 1; films of an iPhone with 27 mm were measured by others as of 32 mm, which is
# 1.09 after the crop from 4:3 to 16:9.
STABILISATION_CROP, FILM_FOCAL_SIGMA = 1.05, 0.05
_MIN_EQUIVALENT_MM, _MAX_EQUIVALENT_MM = 5.0, 500.0


def describe(path: Path) -> Recording:
    """Describe a film and, beside it, an optional file of its name with suffix `.yaml`.

    The file has the keys of `intrinsics.yaml` in the `folder` layout, for the film as it is shown.
    Without it, the focal length is estimated, starting from that of the film's metadata or from a
    typical one. Timestamps are those of the film, also where its frame rate varies; rotation
    metadata is applied.

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
                f"but {path.name} is shown with {width}x{height}; correct the file"
            )
        return Recording(
            path.stem,
            intrinsics.camera,
            files,
            1.0,
            distortion=intrinsics.distortion,
            fisheye=intrinsics.fisheye,
        )
    focal_px = metadata_focal(path, width, height)
    note = f"no intrinsics in {calibration.name}; the focal length is estimated"
    if focal_px is not None:
        note += f" from the {focal_px:.0f} pixels in the metadata of the film"
    return Recording(
        path.stem,
        typical_camera(width, height)
        if focal_px is None
        else camera_with_focal(width, height, focal_px),
        files,
        1.0,
        notes=(note,),
        calibrated=False,
        focal_sigma=None if focal_px is None else FILM_FOCAL_SIGMA,
    )


def metadata_focal(path: Path, width: int, height: int) -> float | None:
    """Focal length in pixels of frames of a film by its metadata; None without one.

    The metadata describe the lens. Films show a part of the sensor: the full width of its 4:3, or
    what stabilisation leaves of that.
    """
    value = read_metadata(path).get(EQUIVALENT_FOCAL_MM)
    try:
        equivalent_mm = float(value) if value is not None else 0.0
    except ValueError:
        return None
    if not _MIN_EQUIVALENT_MM <= equivalent_mm <= _MAX_EQUIVALENT_MM:
        return None
    longer, shorter = max(width, height), min(width, height)
    sensor_width = max(longer, shorter * 4 / 3)
    return STABILISATION_CROP * focal_of_equivalent(
        equivalent_mm, sensor_width, sensor_width / 4 * 3
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
