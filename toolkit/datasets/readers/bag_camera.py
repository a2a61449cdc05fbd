"""Intrinsics from the camera info messages of ROS."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.readers.bag_topics import ImageTopic

_RADIAL = ("plumb_bob", "rational_polynomial", "", "none", "brown conrady", "pinhole", "radtan")
_FISHEYE = ("equidistant", "fisheye", "kannala_brandt4", "kannala brandt4")
# Maximum difference of the intrinsics of registered images, relative to the focal length.
_SAME_CAMERA = 0.01

# A T265 publishes no camera info in many recordings. Its fisheye cameras are of one design; these
# are the values of one device (github.com/AaltoVision/realsense-capture). The focal length, 286
# pixels, follows from the 163 degrees diagonal field of view that Intel specifies.
T265_SIZE = (848, 800)
_T265 = Camera(286.0, 286.0, 423.5, 399.5, *T265_SIZE)
_T265_DISTORTION = (-0.0020, 0.0390, -0.0372, 0.0062)
_T265_SIGMA = 0.02


@dataclass(frozen=True)
class BagCamera:
    """Intrinsics of the images of a topic.

    Attributes:
        camera: pinhole camera.
        distortion: OpenCV's coefficients, or None.
        fisheye: whether they are those of the model of Kannala and Brandt.
        calibrated: whether the focal length is known.
        focal_sigma: relative standard deviation of a nominal focal length.
    """

    camera: Camera
    distortion: tuple[float, ...] | None = None
    fisheye: bool = False
    calibrated: bool = True
    focal_sigma: float | None = None


def camera_of(topic: ImageTopic) -> BagCamera | None:
    """Intrinsics of a topic by its camera info, or None if that is missing or not calibrated.

    Raises:
        DatasetError: the distortion model is not supported, or the info is for another size.
    """
    info = topic.info
    if info is None:
        return _t265(topic)
    ros1 = hasattr(info, "K")
    K = np.asarray(info.K if ros1 else info.k, float).reshape(3, 3)
    D = np.asarray(info.D if ros1 else info.d, float)
    if topic.rectified:
        P = np.asarray(info.P if ros1 else info.p, float).reshape(3, 4)
        K, D = (P[:, :3] if P[0, 0] > 0 else K), np.zeros(0)
    if not K[0, 0] > 0:
        return None  # drivers of uncalibrated cameras publish zeros
    size = int(info.width), int(info.height)
    if size != topic.size:
        raise DatasetError(
            f"{topic.name} has images of {topic.size[0]}x{topic.size[1]} pixels but its camera "
            f"info is for {size[0]}x{size[1]}; record the camera info of these images"
        )
    try:
        camera = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size)
    except SettingsError as error:
        raise DatasetError(f"camera info of {topic.name}: {error}") from error
    return BagCamera(camera, *_distortion(topic.name, info.distortion_model, D))


def _distortion(
    topic: str, model: str, values: np.ndarray
) -> tuple[tuple[float, ...] | None, bool]:
    """OpenCV's coefficients, and whether they are of a fisheye."""
    if not np.isfinite(values).all():
        raise DatasetError(f"the distortion of {topic} is not finite; calibrate the camera")
    last = np.flatnonzero(values)
    name = model.strip().lower()
    if last.size == 0 and name not in _FISHEYE:
        return None, False
    if name in _FISHEYE:
        if last.size and last[-1] >= 4:
            raise DatasetError(
                f"the fisheye of {topic} has more than 4 distortion coefficients; undistort the "
                f"images (image_proc)"
            )
        return tuple(float(v) for v in np.append(values, np.zeros(4))[:4]), True
    if name in _RADIAL and last[-1] < 8:
        count = 5 if last[-1] < 5 else 8
        padded = np.append(values, np.zeros(8))[:count]
        return tuple(float(value) for value in padded), False
    raise DatasetError(
        f"the distortion model {model!r} of {topic} is not supported with these coefficients; "
        f"record rectified images (image_proc)"
    )


def _t265(topic: ImageTopic) -> BagCamera | None:
    """Nominal intrinsics of a T265, recognised by size and name."""
    if topic.size != T265_SIZE or "fisheye" not in topic.name.lower():
        return None
    return BagCamera(_T265, _T265_DISTORTION, True, False, _T265_SIGMA)


def differs(colour: Camera, depth: Camera) -> bool:
    """Whether two cameras of the same size have different intrinsics."""
    difference = np.abs(colour.matrix - depth.matrix).max()
    return bool(difference > _SAME_CAMERA * colour.fx)
