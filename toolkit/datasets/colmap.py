"""A reconstruction of COLMAP as text: images with intrinsics and poses, without depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.common_camera import common_camera
from toolkit.datasets.pairing import attach_poses, listed
from toolkit.datasets.photos import natural_key
from toolkit.errors import DatasetError
from toolkit.io.colmap import ColmapCamera, read_cameras, read_images

FPS = 30.0
_CAMERAS, _IMAGES = "cameras.txt", "images.txt"
# Places of the model in the folder of a project, and of the images seen from the model.
_MODELS = ("sparse/0", "sparse", "", "colmap/sparse/0")
_IMAGE_FOLDERS = ("images", "../images", "../../images", "../../../images")


def describe(path: Path) -> Recording:
    """Describe `sparse/0/cameras.txt`, `sparse/0/images.txt` and the images in `images/`.

    The path is the folder of the project or of the model. Frames are the registered images, sorted
    by name with numbers by value; the timestamp of frame i is i / 30 s. Images of several cameras
    with the same model and size use the median of their intrinsics. The poses become the ground
    truth; their unit of length is COLMAP's.

    Raises:
        DatasetError: there is no text model or an image is missing, or the cameras differ in model
            or size, or by more than 2 % in focal length.
        FormatError: a file is malformed or its camera model is not supported.
    """
    model = _model(path)
    folder = _images(model)
    cameras = read_cameras(model / _CAMERAS)
    images = sorted(read_images(model / _IMAGES), key=lambda image: natural_key(image.name))
    if not images:
        raise DatasetError(f"{model / _IMAGES} contains no images; export the model again")
    for image in images:
        if image.camera_id not in cameras:
            raise DatasetError(
                f"{model / _IMAGES}: {image.name} has camera {image.camera_id}, which {_CAMERAS} "
                f"lacks; export the model again"
            )
    files = tuple(FrameFiles(i / FPS, folder / im.name, None) for i, im in enumerate(images))
    missing = [file.name for file in files if not file.rgb.is_file()]
    if missing:
        raise DatasetError(
            f"{folder} lacks {len(missing)} of {len(files)} images ({listed(missing)}); copy the "
            f"images that COLMAP used"
        )
    used = [cameras[image.camera_id] for image in images]
    _check_models(model / _CAMERAS, used)
    common = common_camera(model / _CAMERAS, [camera.camera for camera in used])
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


def _model(path: Path) -> Path:
    if not path.is_dir():
        raise DatasetError(f"{path} is not a folder; specify the folder of the COLMAP project")
    places = [path / place for place in _MODELS]
    for place in places:
        if all((place / name).exists() for name in (_CAMERAS, _IMAGES)):
            return place
    binary = next((place for place in places if (place / "images.bin").exists()), None)
    if binary is not None:
        raise DatasetError(
            f"{binary} is a binary model; convert it with: colmap model_converter --input_path "
            f"{binary} --output_path {binary} --output_type TXT"
        )
    raise DatasetError(
        f"{path} has no {_CAMERAS} and {_IMAGES}, nor has {_MODELS[0]}/ in it; check the path and "
        f"the kind of the dataset"
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
