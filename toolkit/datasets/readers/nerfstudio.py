"""nerfstudio's `transforms.json` with depth: exports of Polycam, Record3D and nerfstudio itself."""

from __future__ import annotations

import math
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
    OPENGL_AXES,
    attach_poses,
    folder_holding_any,
    is_number,
    natural_key,
    unpaired,
)
from toolkit.io.guarded.documents import read_json
from toolkit.io.images import read_depth_m, read_rgb

FPS = 30.0
METRES_PER_VALUE = 0.001
# nerfstudio's file, and the first one of the layout of Blender's synthetic scenes.
_FILES = (("transforms.json",), ("transforms_train.json",))
_SUFFIXES = (".png", ".jpg", ".jpeg")
_DEPTH_KEYS = ("depth_file_path", "depth_path")
_DISTORTION = ("k1", "k2", "p1", "p2", "k3")
_PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE")
_FISHEYE_MODEL, _FISHEYE_DISTORTION = "OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")


@dataclass(frozen=True)
class _Lens:
    """Intrinsics of the colour image of one frame."""

    camera: Camera
    distortion: tuple[float, ...]
    fisheye: bool = False


def describe(path: Path) -> Recording:
    """Describe the images and depth images that `transforms.json` names.

    Without this file, those of `transforms_train.json`. If it does not contain their size, it is
    that of the first image.

    Frames are sorted by file name, numbers in it by value; the timestamp of frame i
    is i / 30 s. Frames without a depth image are left out. Values of depth images are millimetres,
    or `depth_unit_scale_factor` metres. Colour is resized to smaller depth images. The poses become
    the ground truth.

    Raises:
        DatasetError: the file is malformed, or its frames differ in camera model or size, or by
            more than 2 % in focal length, or the camera model is not supported.
    """
    folder, (name,) = folder_holding_any(path, _FILES, "nerfstudio")
    file = folder / name
    content = _load(file)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DatasetError(f"{file} has no list of frames; export the recording again")
    if not _states_size(content) and not any(_states_size(frame) for frame in frames):
        content = content | _size_of(file, frames[0])
    entries = _sorted([_Entry.parse(file, frame, content) for frame in frames])
    with_depth = [entry for entry in entries if entry.depth is not None]
    used = with_depth or entries
    files = tuple(
        FrameFiles(i / FPS, entry.rgb, entry.depth)
        for i, entry in enumerate(entries)
        if entry.depth is not None or not with_depth
    )
    scale = _number(file, content, "depth_unit_scale_factor", METRES_PER_VALUE)
    if scale <= 0:
        raise DatasetError(f"{file}: depth_unit_scale_factor must be positive, got {scale}")
    lens, lens_flaws = _common_lens(file, [entry.lens for entry in used])
    truth = attach_poses(files, [entry.T_world_camera for entry in used])
    alone = [entry.rgb.name for entry in entries if with_depth and entry.depth is None]
    depth = files[0].depth
    return Recording(
        name=folder.resolve().name,
        camera=lens.camera if depth is None else _camera_of_depth(lens.camera, depth),
        files=files,
        depth_scale=1.0 / scale,
        ground_truth=truth.trajectory,
        distortion=lens.distortion if any(lens.distortion) or lens.fisheye else None,
        fisheye=lens.fisheye,
        colour_may_be_larger=True,
        colour_camera=lens.camera,
        flaws=unpaired("colour image(s) without depth", alone) + truth.flaws + lens_flaws,
    )


def _states_size(values: Any) -> bool:
    return isinstance(values, dict) and "w" in values and "h" in values


def _size_of(file: Path, frame: Any) -> dict[str, int]:
    """The keys `w` and `h` of the image of a frame; none if it has no image."""
    name = frame.get("file_path") if isinstance(frame, dict) else None
    if not isinstance(name, str):
        return {}
    height, width = read_rgb(_resolved(file.parent, name)).shape[:2]
    return {"w": width, "h": height}


@dataclass(frozen=True)
class _Entry:
    """One frame of the file."""

    rgb: Path
    depth: Path | None
    lens: _Lens
    T_world_camera: NDArray[np.float64] | None

    @classmethod
    def parse(cls, file: Path, frame: Any, common: dict[str, Any]) -> _Entry:
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise DatasetError(f"{file}: each entry of frames must have a file_path")
        name = frame["file_path"]
        depth = next((frame[key] for key in _DEPTH_KEYS if isinstance(frame.get(key), str)), None)
        pose = frame.get("transform_matrix")
        return cls(
            _resolved(file.parent, name),
            None if depth is None else _resolved(file.parent, depth),
            _lens(file, name, {**common, **frame}),
            None if pose is None else _pose(file, name, pose),
        )


def _load(file: Path) -> dict[str, Any]:
    try:
        content = read_json(file)
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {file}: {error}; it must be JSON") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{file} must contain a JSON object with the key frames")
    return content


def _resolved(folder: Path, name: str) -> Path:
    """A path of the file, which may have Windows' separators or lack the suffix."""
    path = folder / name.replace("\\", "/")
    if path.exists() or path.suffix.lower() in _SUFFIXES:
        return path
    # Names may contain dots, as "frame.001".
    endings = [path.with_name(path.name + suffix) for suffix in _SUFFIXES]
    return next(
        (file for file in endings if file.exists()), endings[0] if not path.suffix else path
    )


def _sorted(entries: list[_Entry]) -> list[_Entry]:
    if all(is_number(entry.rgb.stem) for entry in entries):
        return sorted(entries, key=lambda entry: float(entry.rgb.stem))
    return sorted(entries, key=lambda entry: natural_key(str(entry.rgb)))


def _pose(file: Path, name: str, rows: Any) -> NDArray[np.float64]:
    try:
        T = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        T = np.zeros(0)
    if T.shape == (3, 4):
        T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
    if T.shape != (4, 4):
        raise DatasetError(f"{file}: transform_matrix of {name} is not a 4x4 matrix")
    return T @ OPENGL_AXES


def _number(file: Path, values: dict[str, Any], key: str, default: float | None = None) -> float:
    value = values.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        problem = "lacks the number" if value is None else "has no valid number"
        raise DatasetError(f"{file} {problem} {key}; export the recording again")
    return float(value)


def _lens(file: Path, name: str, values: dict[str, Any]) -> _Lens:
    """The intrinsics of one frame; those of the frame override the common ones."""
    model = values.get("camera_model", "OPENCV")
    fisheye = model == _FISHEYE_MODEL
    if model not in _PINHOLE_MODELS and not fisheye:
        raise DatasetError(
            f"{file}: camera model {model} of {name} is not supported; undistort the images and "
            f"export them as {_PINHOLE_MODELS[0]}"
        )
    if not fisheye and any(_number(file, values, key, 0.0) for key in ("k4", "k5", "k6")):
        raise DatasetError(f"{file}: {name} has distortion beyond k3; undistort the images")
    width, height = (_number(file, values, key) for key in ("w", "h"))
    if "fl_x" in values or "camera_angle_x" not in values:
        fx = _number(file, values, "fl_x")
    else:
        fx = 0.5 * width / math.tan(0.5 * _number(file, values, "camera_angle_x"))
    fy = _number(file, values, "fl_y", fx)
    cx, cy = _number(file, values, "cx", 0.5 * width), _number(file, values, "cy", 0.5 * height)
    try:
        # In the file, the centre of the first pixel is (0.5, 0.5).
        camera = Camera(fx, fy, cx - 0.5, cy - 0.5, int(width), int(height))
    except SettingsError as error:
        raise DatasetError(f"{file}: {error}; correct the intrinsics") from error
    keys = _FISHEYE_DISTORTION if fisheye else _DISTORTION
    return _Lens(camera, tuple(_number(file, values, key, 0.0) for key in keys), fisheye)


def _common_lens(file: Path, lenses: Sequence[_Lens]) -> tuple[_Lens, tuple[str, ...]]:
    """The median of the frames' intrinsics, and a line about their variation."""
    if len({lens.fisheye for lens in lenses}) > 1:
        raise DatasetError(f"{file} has frames of several camera models; use those of one camera")
    common = common_camera(file, [lens.camera for lens in lenses])
    distortion = np.median([lens.distortion for lens in lenses], axis=0)
    values = tuple(float(k) for k in distortion)
    return _Lens(common.camera, values, lenses[0].fisheye), common.flaws


def _camera_of_depth(colour: Camera, depth_file: Path) -> Camera:
    height, width = read_depth_m(depth_file, 1.0).shape
    return camera_of_depth(colour, (width, height), depth_file)
