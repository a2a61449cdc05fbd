"""A reconstruction of COLMAP: images with intrinsics and poses, without depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.base.errors import DatasetError
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.common_camera import common_camera
from toolkit.datasets.pairing import attach_poses, listed, natural_key
from toolkit.io.colmap import ColmapCamera, read_cameras, read_images

FPS = 30.0
# Names of the files as text, which a user may have edited, and in binary.
_CAMERAS, _IMAGES = "cameras", "images"
_SUFFIXES = (".txt", ".bin")
# Places of the model in the folder of a project, and of the images seen from the model.
_MODELS = ("sparse/0", "sparse", "", "colmap/sparse/0")
_IMAGE_FOLDERS = ("images", "../images", "../../images", "../../../images")


def describe(path: Path) -> Recording:
    """Describe `cameras` and `images` (.txt or .bin) in `sparse/0/`, and the images in `images/`.

    The path is the folder of the project or of the model. Frames are the registered images, sorted
    by name with numbers by value; the timestamp of frame i is i / 30 s. Images of several cameras
    with the same model and size use the median of their intrinsics. The poses become the ground
    truth; their unit of length is COLMAP's.

    Raises:
        DatasetError: there is no model or an image is missing, or the cameras differ in model
            or size, or by more than 2 % in focal length.
        FormatError: a file is malformed or its camera model is not supported.
    """
    camera_file, image_file = _model(path)
    folder = _images(camera_file.parent)
    cameras = read_cameras(camera_file)
    images = sorted(read_images(image_file), key=lambda image: natural_key(image.name))
    if not images:
        raise DatasetError(f"{image_file} contains no images; export the model again")
    for image in images:
        if image.camera_id not in cameras:
            raise DatasetError(
                f"{image_file}: {image.name} has camera {image.camera_id}, which "
                f"{camera_file.name} lacks; export the model again"
            )
    files = tuple(FrameFiles(i / FPS, folder / im.name, None) for i, im in enumerate(images))
    missing = [file.name for file in files if not file.rgb.is_file()]
    if missing:
        raise DatasetError(
            f"{folder} lacks {len(missing)} of {len(files)} images ({listed(missing)}); copy the "
            f"images that COLMAP used"
        )
    used = [cameras[image.camera_id] for image in images]
    _check_models(camera_file, used)
    common = common_camera(
        camera_file,
        [camera.camera for camera in used],
        "if it was one camera, reconstruct with `--ImageReader.single_camera 1` of `colmap "
        "feature_extractor`",
    )
    truth = attach_poses(files, [image.T_world_camera for image in images])
    return Recording(
        name=path.resolve().name,
        camera=common.camera,
        files=files,
        depth_scale=1.0,
        ground_truth=truth.trajectory,
        distortion=_median_distortion(used),
        fisheye=used[0].fisheye,
        flaws=truth.flaws + common.flaws,
    )


def _model(path: Path) -> tuple[Path, Path]:
    """The files of cameras and of images."""
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; specify the folder of the COLMAP project")
    for place in (path / place for place in _MODELS):
        for suffix in _SUFFIXES:
            files = place / f"{_CAMERAS}{suffix}", place / f"{_IMAGES}{suffix}"
            if all(file.exists() for file in files):
                return files
    raise DatasetError(
        f"{path} has no {_CAMERAS}.bin and {_IMAGES}.bin (or .txt), nor has {_MODELS[0]}/ in it; "
        f"check the path and the kind of the dataset"
    )


def _images(model: Path) -> Path:
    for name in _IMAGE_FOLDERS:
        if (model.resolve() / name).is_dir():
            return (model.resolve() / name).resolve()
    raise DatasetError(f"there is no folder images/ beside {model}; copy the images there")


def _check_models(file: Path, cameras: list[ColmapCamera]) -> None:
    kinds = {(c.fisheye, len(c.distortion) if c.distortion else 0) for c in cameras}
    if len({fisheye for fisheye, _ in kinds}) > 1 or len({n for _, n in kinds if n}) > 1:
        raise DatasetError(f"{file} has cameras of several models; use the images of one camera")


def _median_distortion(cameras: list[ColmapCamera]) -> tuple[float, ...] | None:
    count = max(len(camera.distortion or ()) for camera in cameras)
    if count == 0:
        return None
    values = [camera.distortion or (0.0,) * count for camera in cameras]
    return tuple(float(value) for value in np.median(values, axis=0))
