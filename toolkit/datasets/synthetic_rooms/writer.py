"""Writing of synthetic sequences in Replica's layout (NICE-SLAM) with labels and mesh.

Colour images are PNG files, because JPEG artefacts would limit the PSNR to about 40 dB.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import DatasetError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.geometry.open3d_bridge import open3d
from toolkit.datasets.synthetic_rooms.ray_casting import RayCastView, Scene
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS

DEPTH_SCALE = 6553.5
MARKER = "room.json"
WALKER = "walker"
SURFACE = "surface"
INSTANCES = "instances"


def prepare_folder(path: Path) -> None:
    """Create the folder and delete the files of an earlier room in it.

    Raises:
        DatasetError: the folder contains files that are not of a synthetic room.
    """
    if path.exists() and not path.is_dir():
        raise DatasetError(f"{path} is a file; give a folder for the room")
    if path.is_dir() and any(path.iterdir()) and not (path / MARKER).is_file():
        raise DatasetError(f"{path} is not empty and not a synthetic room; give another folder")
    try:
        for folder in (path, path / "unseen"):
            for name in ("results", "labels"):
                (folder / name).mkdir(parents=True, exist_ok=True)
                _remove_images(folder / name)
            _remove_images(folder / SURFACE)
            _remove_images(folder / INSTANCES)
        _remove_images(path / WALKER)
        # Empty until the room is complete, so that an interrupted room can be recreated.
        (path / MARKER).write_bytes(b"")
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error.strerror}; choose another folder"
        ) from error


def _remove_images(folder: Path) -> None:
    for old in folder.glob("*.png"):
        old.unlink()


def with_walker_masks(path: Path, views: Iterable[RayCastView]) -> Iterator[RayCastView]:
    """Write the walker's mask of each view that passes: 255 where it is visible, 0 elsewhere."""
    for index, view in enumerate(views):
        if view.walker is not None:
            folder = _made(path / WALKER)
            _write_png(folder / f"walker{index:06d}.png", 255 * view.walker.astype(np.uint8))
        yield view


def with_instances(path: Path, views: Iterable[RayCastView]) -> Iterator[RayCastView]:
    """Write the numbers of the objects in each view that passes, as 16-bit PNG files."""
    folder = _made(path / INSTANCES)
    for index, view in enumerate(views):
        if view.objects is not None:
            _write_png(folder / f"instance{index:06d}.png", view.objects.astype(np.uint16))
        yield view


def with_surfaces(path: Path, views: Iterable[RayCastView]) -> Iterator[RayCastView]:
    """Write the true depth and the finish of the surfaces of each view of a glossy room."""
    folder = _made(path / SURFACE)
    for index, view in enumerate(views):
        if view.reflection is not None:
            _write_png(folder / f"depth{index:06d}.png", _stored(view.reflection.surface_m))
            _write_png(folder / f"finish{index:06d}.png", view.reflection.finish)
        yield view


def write_sequence(
    path: Path,
    frames: Iterable[Frame],
    camera: Camera,
    T_world_camera: NDArray,
    class_ids: Mapping[str, int] = CLASS_IDS,
) -> None:
    """Write images, poses [N, 4, 4], intrinsics and class names into a prepared folder.

    Label images have 8 bits, and 16 with more than 255 classes.
    """
    label_type = np.uint8 if max(class_ids.values()) <= 255 else np.uint16
    for frame in frames:
        stem = f"{frame.index:06d}.png"
        bgr = np.round(frame.rgb[..., ::-1] * 255.0).astype(np.uint8)
        _write_png(path / "results" / f"frame{stem}", bgr)
        _write_png(path / "results" / f"depth{stem}", _stored(frame.depth_m))
        if frame.labels is not None:
            _write_png(path / "labels" / f"label{stem}", frame.labels.astype(label_type))
    rows = np.asarray(T_world_camera).reshape(-1, 16)
    lines = [" ".join(f"{value:.9f}" for value in row) for row in rows]
    _write_text(path / "traj.txt", "\n".join(lines) + "\n")
    write_json(path / "cam_params.json", {"camera": _intrinsics(camera)})
    classes = {str(number): name for name, number in class_ids.items()}
    write_json(path / "labels" / "classes.json", {"void": 0, "classes": classes})


def _stored(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Depth for a file, 0 where it is missing or beyond the largest value, 10 m."""
    values = np.round(depth_m * DEPTH_SCALE)
    return np.where(values > 65535, 0, values).astype(np.uint16)


def write_mesh(path: Path, scene: Scene) -> None:
    """Write the ground-truth mesh with vertex colours as PLY."""
    o3d = open3d()
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(scene.vertices_m),
        o3d.utility.Vector3iVector(scene.triangles.astype(np.int32)),
    )
    mesh.vertex_colors = o3d.utility.Vector3dVector(scene.vertex_colours().astype(np.float64))
    if not o3d.io.write_triangle_mesh(str(path), mesh):
        raise DatasetError(f"cannot write {path}; check free space and permission")


def _intrinsics(camera: Camera) -> dict[str, float]:
    return {
        "w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy,
        "cx": camera.cx, "cy": camera.cy, "scale": DEPTH_SCALE,
    }  # fmt: skip


def _made(folder: Path) -> Path:
    """The folder, which is created if it is missing."""
    try:
        folder.mkdir(exist_ok=True)
    except OSError as error:
        raise DatasetError(f"cannot write {folder}: {error.strerror}") from error
    return folder


def _write_png(path: Path, image: NDArray) -> None:
    try:
        written = cv2.imwrite(os.fsencode(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    except cv2.error:
        written = False
    if not written:
        raise DatasetError(f"cannot write {path}; check free space and permission")


def write_json(path: Path, content: dict) -> None:
    _write_text(path, json.dumps(content, indent=1) + "\n")


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise DatasetError(
            f"cannot write {path}: {error.strerror}; choose another folder"
        ) from error
