"""The toolkit's own dataset layout: rgb/, depth/, intrinsics.yaml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import FrameFiles, Recording
from toolkit.datasets.pairing import (
    attach_poses,
    by_key,
    folder_holding,
    in_order,
    pairing_flaws,
)
from toolkit.io.class_names import read_class_names
from toolkit.io.guarded.documents import read_yaml
from toolkit.io.trajectories import read_tum_lines, text_lines
from toolkit.io.user_files import visible

DEFAULT_FPS = 30.0
_REQUIRED = ("fx", "fy", "cx", "cy", "width", "height")
_OPTIONAL = ("depth_scale", "distortion", "fisheye", "fps", "readout_ms")
_COLOUR_SUFFIXES = (".png", ".jpg", ".jpeg")


@dataclass(frozen=True)
class Intrinsics:
    """Content of `intrinsics.yaml`: camera, depth values per metre, distortion, frame rate.

    Without depth, `depth_scale` is 1. With `fisheye`, `distortion` is the key of that name.
    `readout_s` is that of a rolling shutter, in seconds; None if it is not specified.
    """

    camera: Camera
    depth_scale: float
    distortion: tuple[float, ...] | None
    fps: float
    fisheye: bool = False
    readout_s: float | None = None


def describe(path: Path) -> Recording:
    """Describe `rgb/STEM.*`, `intrinsics.yaml` and optional files.

    Frames are sorted by stem, numbers in it by value. The timestamp of frame i is
    i / fps, unless `timestamps.txt` exists. Optional files are `depth/STEM.png`,
    `labels/STEM.png` with `labels/classes.json`, and `trajectory.txt` in TUM format with the same
    timestamps.

    Raises:
        DatasetError: the folder has a different layout, or `intrinsics.yaml` or `timestamps.txt` is
            malformed.
        FormatError: `trajectory.txt` is malformed.
    """
    folder = folder_holding(path, ("rgb", "intrinsics.yaml"), "folder")
    has_depth = (folder / "depth").exists()
    intrinsics = read_intrinsics(folder / "intrinsics.yaml", has_depth)
    rgb = _by_stem(folder / "rgb", _COLOUR_SUFFIXES)
    depth = _by_stem(folder / "depth", (".png",))
    labels = _by_stem(folder / "labels", (".png",))
    stems = [stem for stem in rgb if stem in depth or not has_depth]
    if not stems:
        raise DatasetError(_why_no_frames(folder, rgb, depth))
    times_s = _timestamps_s(folder / "timestamps.txt", stems, intrinsics.fps)
    files = tuple(
        FrameFiles(time_s, rgb[stem], depth.get(stem), labels.get(stem))
        for time_s, stem in zip(times_s, stems, strict=True)
    )
    trajectory, flaws = None, pairing_flaws(rgb, depth if has_depth else rgb, labels)
    if (folder / "trajectory.txt").exists():
        truth = attach_poses(files, _poses(folder / "trajectory.txt", files, intrinsics.fps))
        trajectory, flaws = truth.trajectory, flaws + truth.flaws
    return Recording(
        name=folder.resolve().name,
        camera=intrinsics.camera,
        files=files,
        depth_scale=intrinsics.depth_scale,
        ground_truth=trajectory,
        label_names=read_class_names(folder / "labels" / "classes.json") if labels else None,
        distortion=intrinsics.distortion,
        fisheye=intrinsics.fisheye,
        flaws=flaws,
        readout_s=intrinsics.readout_s,
    )


def _why_no_frames(folder: Path, rgb: dict[str, Path], depth: dict[str, Path]) -> str:
    if not rgb:
        return (
            f"{folder / 'rgb'} contains no images ({', '.join(_COLOUR_SUFFIXES)}); convert others "
            "to one of these formats"
        )
    if not depth:
        return (
            f"{folder / 'depth'} contains no .png images; convert depth to 16-bit PNG, or remove "
            "this folder and run with --depth none"
        )
    return (
        f"no image in {folder / 'depth'} has the name of one in rgb "
        f"({next(iter(depth.values())).name}, {next(iter(rgb.values())).name}); rename them so "
        "that colour and depth of a frame have the same name before the suffix"
    )


def read_intrinsics(path: Path, has_depth: bool = True) -> Intrinsics:
    """Read `intrinsics.yaml`; unknown keys are errors.

    Args:
        has_depth: whether `depth_scale` is required.

    Raises:
        DatasetError: a key is missing, unknown, of the wrong type or out of range.
    """
    values = _load_mapping(path)
    required = (*_REQUIRED, "depth_scale") if has_depth else _REQUIRED
    for key in required:
        if key not in values:
            raise DatasetError(
                f"{path} lacks the key {key}; required keys are {', '.join(required)}"
            )
    for key in values:
        if key not in _REQUIRED + _OPTIONAL:
            raise DatasetError(
                f"{path} has the unknown key {key!r}; supported keys are "
                f"{', '.join(_REQUIRED + _OPTIONAL)}"
            )
    try:
        camera = _camera(values)
        depth_scale = _number("depth_scale", values.get("depth_scale", 1.0))
        fps = _number("fps", values.get("fps", DEFAULT_FPS))
        readout_ms = _number("readout_ms", values["readout_ms"]) if "readout_ms" in values else None
        distortion = tuple(float(k) for k in values.get("distortion") or ())
        fisheye = tuple(float(k) for k in values.get("fisheye") or ())
    except (TypeError, ValueError, OverflowError, SettingsError) as error:
        raise DatasetError(f"{path}: {error}; correct the value") from error
    if len(distortion) not in (0, 5, 8) or not np.isfinite(distortion).all():
        raise DatasetError(
            f"{path}: distortion must be the 5 numbers [k1, k2, p1, p2, k3], or 8 with k4, k5, k6"
        )
    if len(fisheye) not in (0, 4) or not np.isfinite(fisheye).all() or (fisheye and distortion):
        raise DatasetError(
            f"{path}: fisheye must be the 4 numbers [k1, k2, k3, k4], without distortion"
        )
    for key, value in (("depth_scale", depth_scale), ("fps", fps)):
        if not 0 < value < float("inf"):
            raise DatasetError(f"{path}: {key} must be positive, got {value}")
    if readout_ms is not None and not 0 <= readout_ms < 1e3:
        raise DatasetError(
            f"{path}: readout_ms must be milliseconds between 0 and 1000, got {readout_ms}"
        )
    readout_s = None if readout_ms is None else 1e-3 * readout_ms
    return Intrinsics(
        camera, depth_scale, fisheye or distortion or None, fps, bool(fisheye), readout_s
    )


def _camera(values: dict[str, Any]) -> Camera:
    fx, fy, cx, cy, width, height = (_number(key, values[key]) for key in _REQUIRED)
    for key, number in (("width", width), ("height", height)):
        if number != int(number):
            raise ValueError(f"{key} must be a whole number of pixels, got {number:g}")
    return Camera(fx, fy, cx, cy, int(width), int(height))


def _number(key: str, value: Any) -> float:
    """The value of a key. YAML also has truth values (`on`, `yes`), which Python counts as 1."""
    if isinstance(value, bool):
        raise ValueError(f"{key} must be a number, got {value}")
    return float(value)


def _load_mapping(path: Path) -> dict:
    try:
        values = read_yaml(path)
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {error}; it must be YAML") from error
    if not isinstance(values, dict):
        raise DatasetError(f"{path} must contain `key: value` lines: {', '.join(_REQUIRED)}")
    return values


def _by_stem(folder: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Return files by stem, in the order of the frames."""
    files = visible(folder) if folder.is_dir() else ()
    found = by_key((file.stem, file) for file in files if file.suffix.lower() in suffixes)
    return {stem: found[stem] for stem in in_order(found)}


def _poses(
    path: Path, files: tuple[FrameFiles, ...], fps: float
) -> list[NDArray[np.float64] | None]:
    """Return the pose of each frame, or None if no timestamp is within half a frame period."""
    poses = read_tum_lines(path)
    times_s = np.array([frame.timestamp_s for frame in files])
    found: dict[int, NDArray[np.float64]] = {}
    for time_s, pose in zip(poses.timestamps_s, poses.T_world_camera, strict=True):
        nearest = int(np.abs(times_s - time_s).argmin()) if len(times_s) else 0
        if len(times_s) and abs(times_s[nearest] - time_s) * fps <= 0.5:
            found.setdefault(nearest, pose)
    return [found.get(i) for i in range(len(files))]


def _timestamps_s(path: Path, stems: list[str], fps: float) -> list[float]:
    """Return the times of the frames: lines of stem and seconds, else equal intervals."""
    if not path.exists():
        return [i / fps for i in range(len(stems))]
    times_s: dict[str, float] = {}
    for number, line in text_lines(path):
        words = line.rsplit(maxsplit=1)  # stems may contain spaces
        try:
            stem, time_s = words[0], float(words[1])
        except (ValueError, IndexError) as error:
            raise DatasetError(
                f"{path}, line {number}: each line must have a stem and seconds, got {line!r}"
            ) from error
        if stem in times_s:
            raise DatasetError(f"{path}, line {number}: frame {stem} has two times; remove one")
        times_s[stem] = time_s
    missing = next((stem for stem in stems if stem not in times_s), None)
    if missing is not None:
        raise DatasetError(f"{path} lacks the frame {missing}; add its time or remove its images")
    found = [times_s[stem] for stem in stems]
    for stem, time_s, before_s in zip(stems, found, [-np.inf, *found], strict=False):
        if not before_s < time_s < np.inf:
            raise DatasetError(
                f"{path}: the time of frame {stem} must be finite and increase; correct the file, "
                "or move each recording to a folder of its own"
            )
    return found
