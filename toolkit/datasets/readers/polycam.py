"""Polycam: raw data of an iPhone or iPad with LiDAR.

Source: "Polycam's data format" in the README of github.com/PolyCam/polyform. Files of `keyframes/`
belong together by name, which is the time in microseconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.common_camera import camera_of_depth, common_camera
from toolkit.datasets.pairing import (
    ARKIT_UP,
    OPENGL_AXES,
    attach_poses,
    folder_holding,
    is_number,
    natural_key,
    unpaired,
)
from toolkit.io.guarded.documents import read_json
from toolkit.io.images import read_depth_m
from toolkit.io.user_files import visible

DEPTH_SCALE = 1000.0
FPS = 30.0
_KEYFRAMES = "keyframes"
_MAX_CAMERA_BYTES = 2**20
_SUFFIXES = (".jpg", ".jpeg", ".png")


def describe(path: Path) -> Recording:
    """Describe `keyframes/` with images, cameras, depth and optional confidence.

    `corrected_images/` and `corrected_cameras/`, which Polycam undistorts and optimises, are used
    where both exist, otherwise `images/` and `cameras/`. Frames without depth are left out, unless
    there is no depth at all. Colour is resized to smaller depth images. Depth with the confidence 0
    counts as missing. The poses become the ground truth.

    Raises:
        DatasetError: the folder has a different layout, a camera is malformed, or the focal length
            changes by more than 2 %.
    """
    folder = _keyframes(path)
    corrected = all((folder / f"corrected_{kind}").is_dir() for kind in ("images", "cameras"))
    prefix = "corrected_" if corrected else ""
    rgb = _by_stem(folder / f"{prefix}images", _SUFFIXES)
    cameras = _by_stem(folder / f"{prefix}cameras", (".json",))
    depth = _by_stem(folder / "depth", (".png",))
    confidence = _by_stem(folder / "confidence", (".png",))
    known = [stem for stem in rgb if stem in cameras]
    used = [stem for stem in known if stem in depth or not depth]
    if not used:
        raise DatasetError(
            f"{folder} has no image with a camera{' and depth' if depth else ''} of the same name; "
            f"export the raw data again"
        )
    timed = all(is_number(stem) for stem in used)
    files = tuple(
        FrameFiles(
            1e-6 * float(stem) if timed else i / FPS,
            rgb[stem],
            depth.get(stem),
            confidence=confidence.get(stem),
        )
        for i, stem in enumerate(used)
    )
    entries = [_Entry.read(cameras[stem]) for stem in used]
    common = common_camera(folder / f"{prefix}cameras", [entry.camera for entry in entries])
    truth = attach_poses(files, [entry.T_world_camera for entry in entries])
    camera = common.camera
    if depth:
        height, width = read_depth_m(depth[used[0]], DEPTH_SCALE).shape
        camera = camera_of_depth(camera, (width, height), depth[used[0]])
    return Recording(
        name=folder.parent.resolve().name,
        camera=camera,
        files=files,
        depth_scale=DEPTH_SCALE,
        ground_truth=truth.trajectory,
        up_world=ARKIT_UP,
        colour_may_be_larger=True,
        colour_camera=common.camera,
        flaws=unpaired("image(s) without a camera", _names(rgb, cameras))
        + unpaired("image(s) without depth", _names(rgb, depth) if depth else [])
        + truth.flaws
        + common.flaws,
        notes=() if corrected else ("no corrected_images; the lens distortion is not corrected",),
    )


@dataclass(frozen=True)
class _Entry:
    """Content of a camera's file."""

    camera: Camera
    T_world_camera: NDArray[np.float64]

    @classmethod
    def read(cls, file: Path) -> _Entry:
        try:
            content = read_json(file, max_bytes=_MAX_CAMERA_BYTES)
        except (OSError, ValueError) as error:
            raise DatasetError(f"cannot read {file}: {error}; it must be JSON") from error
        keys = ["fx", "fy", "cx", "cy", "width", "height"]
        rows = [f"t_{i}{j}" for i in range(3) for j in range(4)]
        fx, fy, cx, cy, width, height = _numbers(file, content, keys)
        T = np.vstack([np.reshape(_numbers(file, content, rows), (3, 4)), [0.0, 0.0, 0.0, 1.0]])
        try:
            # ARKit measures the principal point from the corner of the first pixel.
            camera = Camera(fx, fy, cx - 0.5, cy - 0.5, int(width), int(height))
        except (SettingsError, ValueError, OverflowError) as error:
            raise DatasetError(f"{file}: {error}; export the raw data again") from error
        return cls(camera, T @ OPENGL_AXES)


def _keyframes(path: Path) -> Path:
    if path.is_file():
        raise DatasetError(f"{path} is a file; unpack the raw data and specify its folder")
    if path.name == _KEYFRAMES and path.is_dir():
        return path
    return folder_holding(path, (_KEYFRAMES,), "Polycam") / _KEYFRAMES


def _by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    if not folder.is_dir():
        return {}
    found = [file for file in visible(folder) if file.suffix.lower() in suffixes]
    return {file.stem: file for file in sorted(found, key=lambda file: natural_key(file.stem))}


def _names(files: dict[str, Path], others: dict[str, Path]) -> list[str]:
    return [file.name for stem, file in files.items() if stem not in others]


def _numbers(file: Path, content: Any, keys: Sequence[str]) -> list[float]:
    numbers = []
    for key in keys:
        value = content.get(key) if isinstance(content, dict) else None
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise DatasetError(f"{file} lacks the number {key}; export the raw data again")
        numbers.append(float(value))
    return numbers
