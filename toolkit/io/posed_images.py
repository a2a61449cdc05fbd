"""Write images with known poses for other tools: models of COLMAP, `transforms.json` of nerfstudio.

Both tools place the centre of the first pixel at (0.5, 0.5), ours is at (0, 0): principal points
are shifted by half a pixel. nerfstudio's cameras look along -z with y up (OpenGL).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.io.atomic import utf8, write_bytes, write_text

# COLMAP's number and name of the camera model with parameters fx fy cx cy.
_PINHOLE, _PINHOLE_NAME = 1, "PINHOLE"
_CAMERA_ID = 1
# COLMAP's value for a reprojection error that was not computed.
_NO_ERROR = -1.0
# Axes of nerfstudio's cameras (x right, y up, z backward) in ours (x right, y down, z forward).
_OPENGL_AXES = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class PosedImage:
    """An image file and its pose.

    Attributes:
        name: path of the image: of COLMAP relative to the folder of images, of nerfstudio relative
            to the folder of `transforms.json`, or absolute.
        T_world_camera: [4, 4] float64, camera to world, metres.
    """

    name: str
    T_world_camera: NDArray[np.float64]


@dataclass(frozen=True)
class ColouredPoints:
    """A point cloud.

    Attributes:
        points_m: [N, 3] float, world, metres.
        rgb: [N, 3] uint8.
    """

    points_m: NDArray[np.floating]
    rgb: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points_m)


def write_colmap_text(
    folder: Path, camera: Camera, images: Sequence[PosedImage], points: ColouredPoints
) -> None:
    """Write `cameras.txt`, `images.txt` and `points3D.txt`; points have no tracks.

    Raises:
        RunFolderError: a file cannot be written.
    """
    parameters = " ".join(repr(value) for value in _parameters(camera))
    cameras = [
        "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
        f"{_CAMERA_ID} {_PINHOLE_NAME} {camera.width} {camera.height} {parameters}",
    ]
    rows = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[] as (X Y POINT3D_ID)"]
    for number, image in enumerate(images, start=1):
        pose = " ".join(repr(value) for value in _pose(image))
        rows += [f"{number} {pose} {_CAMERA_ID} {image.name}", ""]
    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)"]
    for number, (point, rgb) in enumerate(_point_rows(points), start=1):
        x, y, z = (repr(value) for value in point)
        lines.append(f"{number} {x} {y} {z} {rgb[0]} {rgb[1]} {rgb[2]} {_NO_ERROR}")
    for name, content in (("cameras", cameras), ("images", rows), ("points3D", lines)):
        write_text(folder / f"{name}.txt", "\n".join(content) + "\n")


def write_colmap_binary(
    folder: Path, camera: Camera, images: Sequence[PosedImage], points: ColouredPoints
) -> None:
    """Write `cameras.bin`, `images.bin` and `points3D.bin`; points have no tracks.

    Raises:
        RunFolderError: a file cannot be written.
    """
    head = struct.pack("<QiiQQ", 1, _CAMERA_ID, _PINHOLE, camera.width, camera.height)
    write_bytes(folder / "cameras.bin", head + struct.pack("<4d", *_parameters(camera)))
    rows = [struct.pack("<Q", len(images))]
    for number, image in enumerate(images, start=1):
        rows.append(struct.pack("<I7dI", number, *_pose(image), _CAMERA_ID))
        rows.append(utf8(image.name) + b"\0" + struct.pack("<Q", 0))
    write_bytes(folder / "images.bin", b"".join(rows))
    parts = [struct.pack("<Q", len(points))]
    for number, (point, rgb) in enumerate(_point_rows(points), start=1):
        parts.append(struct.pack("<Q3d3BdQ", number, *point, *rgb, _NO_ERROR, 0))
    write_bytes(folder / "points3D.bin", b"".join(parts))


def write_transforms(
    file: Path, camera: Camera, images: Sequence[PosedImage], points: str | None = None
) -> None:
    """Write nerfstudio's `transforms.json`.

    Args:
        points: path of a point cloud for initialisation relative to the folder of `file`, or None.

    Raises:
        RunFolderError: the file cannot be written.
    """
    fx, fy, cx, cy = _parameters(camera)
    content = {
        "camera_model": "PINHOLE",
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx,
        "cy": cy,
        "w": camera.width,
        "h": camera.height,
        **({} if points is None else {"ply_file_path": points}),
        "frames": [
            {
                "file_path": image.name,
                "transform_matrix": (image.T_world_camera @ _OPENGL_AXES).tolist(),
            }
            for image in images
        ],
    }
    write_text(file, json.dumps(content, indent=1) + "\n")


def _parameters(camera: Camera) -> tuple[float, float, float, float]:
    """Return fx fy cx cy with pixel centres at 0.5."""
    return float(camera.fx), float(camera.fy), camera.cx + 0.5, camera.cy + 0.5


def _pose(image: PosedImage) -> list[float]:
    """Return qw qx qy qz tx ty tz from world to camera."""
    T_camera_world = se3.inverse(image.T_world_camera)
    x, y, z, w = se3.quaternion_xyzw(T_camera_world[:3, :3]).tolist()
    return [w, x, y, z, *T_camera_world[:3, 3].tolist()]


def _point_rows(points: ColouredPoints) -> Iterator[tuple[list[float], list[int]]]:
    return zip(points.points_m.astype(float).tolist(), points.rgb.tolist(), strict=True)
