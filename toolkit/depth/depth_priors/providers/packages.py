"""What the adapters of model packages share: importing, images in, poses and cameras out."""

from __future__ import annotations

import hashlib
import importlib
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DependencyError, FormatError
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.options import PriorModelOptions

Bytes = NDArray[np.uint8]
_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")
_BLOCK = 1 << 20


def import_package(module: str, options: PriorModelOptions, source: str) -> ModuleType:
    """Import a module of a package that is not a dependency.

    Args:
        options: `code` is searched first, if it is set.
        source: where the package can be found.

    Raises:
        DependencyError: it cannot be imported.
    """
    if options.code is not None and str(options.code) not in sys.path:
        sys.path.insert(0, str(options.code))
    try:
        return importlib.import_module(module)
    except (ImportError, OSError) as error:
        raise DependencyError(
            f"{module} cannot be imported ({error}); install it from {source}, or set "
            "--depth-prior.model.code to its folder"
        ) from error


def weights_of(options: PriorModelOptions) -> Path:
    """The file or folder of the weights, so that packages do not look for them on the internet.

    Raises:
        FormatError: it does not exist.
    """
    path = options.path
    if path is None or not path.exists():
        raise FormatError(f"{path} does not exist; set --depth-prior.model.path to the weights")
    return path


def image_of(frame: Frame) -> Bytes:
    """The image [H, W, 3] of a frame in bytes."""
    return np.rint(np.clip(frame.rgb, 0.0, 1.0) * 255.0).astype(np.uint8)


def resized(image: Bytes, size: tuple[int, int]) -> Bytes:
    """An image resized to (width, height)."""
    smaller = size[0] < image.shape[1]
    method = cv2.INTER_AREA if smaller else cv2.INTER_CUBIC
    return np.asarray(cv2.resize(image, size, interpolation=method), np.uint8)


def relative_poses(T_camera_world: NDArray) -> NDArray[np.float64]:
    """T_first_camera [S, 4, 4] of world-to-camera matrices [S, 3 or 4, 4]."""
    full = np.tile(np.eye(4), (len(T_camera_world), 1, 1))
    full[:, :3] = np.asarray(T_camera_world, np.float64)[:, :3]
    return np.asarray(full[0] @ se3.inverse(full))


def camera_of(matrix: NDArray, size: tuple[int, int]) -> Camera | None:
    """Camera of an intrinsic matrix [3, 3] whose first pixel has its centre at (0.5, 0.5).

    Returns:
        None if the matrix contains no valid focal length.
    """
    fx, fy, cx, cy = (float(matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if not np.isfinite([fx, fy, cx, cy]).all() or min(fx, fy) <= 0:
        return None
    return Camera(fx, fy, cx - 0.5, cy - 0.5, *size)


def sha256_of(path: Path) -> str | None:
    """Hash of a file with weights, or of all such files in a folder by name; None without any."""
    files = [path]
    if path.is_dir():
        files = sorted(f for f in path.iterdir() if f.suffix in _SUFFIXES)
    if not files or not files[0].is_file():
        return None
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as content:
            while block := content.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()
