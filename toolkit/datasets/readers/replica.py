"""Replica in the layout of NICE-SLAM, which is also used for synthetic rooms."""

from __future__ import annotations

from pathlib import Path

from toolkit.base.errors import DatasetError, SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.base import Recording
from toolkit.datasets.pairing import (
    attach_poses,
    folder_holding,
    numbered,
    pair_numbered,
    pairing_flaws,
)
from toolkit.io.class_names import read_class_names
from toolkit.io.guarded.documents import read_json
from toolkit.io.trajectories import read_matrix_lines

# Frame rate; the layout has no timestamps.
FPS = 30.0
DEFAULT_DEPTH_SCALE = 6553.5
_MAX_CAMERA_BYTES = 2**20


def describe(path: Path) -> Recording:
    """Describe `results/frameN.jpg|png`, `results/depthN.png`, `traj.txt`, `cam_params.json`.

    The pose of frame N is line N of `traj.txt`, counted from 0. `cam_params.json` is in the folder
    or its parent; `labels/labelN.png` with `labels/classes.json` are optional.

    Raises:
        DatasetError: the folder has a different layout, or a file is malformed.
    """
    folder = folder_holding(path, ("results",), "Replica")
    rgb = numbered(folder / "results", r"frame(\d+)\.(?:jpg|png)")
    depth = numbered(folder / "results", r"depth(\d+)\.png")
    labels = numbered(folder / "labels", r"label(\d+)\.png")
    files = pair_numbered(rgb, depth, labels, FPS)
    camera_file = _in_folder_or_above(folder, "cam_params.json")
    if camera_file is None:
        raise DatasetError(
            f"neither {folder} nor its parent contains cam_params.json; copy it from the dataset"
        )
    camera, depth_scale = read_camera(camera_file)
    trajectory, flaws = None, pairing_flaws(rgb, depth, labels)
    if (folder / "traj.txt").exists():
        lines = read_matrix_lines(folder / "traj.txt")
        numbers = [number for number in rgb if number in depth]
        truth = attach_poses(files, [lines[n] if n < len(lines) else None for n in numbers])
        trajectory, flaws = truth.trajectory, flaws + truth.flaws
    names_file = _in_folder_or_above(folder, "labels/classes.json") if labels else None
    if labels and names_file is None:
        flaws += ("labels/ has no classes.json, so classes have no names",)
    return Recording(
        name=folder.resolve().name,
        camera=camera,
        files=files,
        depth_scale=depth_scale,
        ground_truth=trajectory,
        label_names=read_class_names(names_file) if names_file else None,
        readout_s=0.0,
        flaws=flaws,
    )


def read_camera(path: Path) -> tuple[Camera, float]:
    """Read the camera and the depth scale of a `cam_params.json`.

    Raises:
        DatasetError: the file is malformed or a value is out of range.
    """
    try:
        values = read_json(path, max_bytes=_MAX_CAMERA_BYTES)["camera"]
        camera = Camera(
            fx=float(values["fx"]),
            fy=float(values["fy"]),
            cx=float(values["cx"]),
            cy=float(values["cy"]),
            width=int(values["w"]),
            height=int(values["h"]),
        )
        depth_scale = float(values.get("scale", DEFAULT_DEPTH_SCALE))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, SettingsError) as error:
        raise DatasetError(
            f'{path} must contain {{"camera": {{w, h, fx, fy, cx, cy, scale}}}} '
            f"({type(error).__name__}: {error}); correct it"
        ) from error
    if not 0 < depth_scale < float("inf"):
        raise DatasetError(f"{path}: scale must be positive (depth values per metre)")
    return camera, depth_scale


def _in_folder_or_above(folder: Path, name: str) -> Path | None:
    found = (place / name for place in (folder, folder.resolve().parent))
    return next((file for file in found if file.exists()), None)
