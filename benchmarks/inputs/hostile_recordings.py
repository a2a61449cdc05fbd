"""Small valid recordings, to be damaged; the tests damage those of the other layouts."""

from __future__ import annotations

import json
import struct
import zipfile
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.io import images
from toolkit.io.trajectories import write_tum

FRAMES, WIDTH, HEIGHT = 2, 32, 24
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_CLASSES = {
    "void": 0,
    "classes": {"1": "wall", "2": "chair"},
    "colours": {"1": [9, 9, 9], "2": [200, 0, 0]},
}
_INTRINSICS = {
    "fx": 30.0,
    "fy": 31.0,
    "cx": 15.5,
    "cy": 11.5,
    "width": WIDTH,
    "height": HEIGHT,
    "fps": 10.0,
    "distortion": [0.01, 0.0, 0.0, 0.0, 0.0],
}
Array = NDArray[np.floating]


def rgb(index: int) -> Array:
    """Random colours [H, W, 3]."""
    return np.random.default_rng(index).uniform(size=(HEIGHT, WIDTH, 3))


def depth_m(index: int) -> Array:
    """A slanted plane [H, W]."""
    return np.tile(np.linspace(1.0, 2.0, WIDTH), (HEIGHT, 1)) + 0.1 * index


def pose(index: int) -> NDArray[np.float64]:
    """A moving and turning camera [4, 4]."""
    return se3.exp(np.array([0.1 * index, 0.0, 0.05 * index, 0.0, 0.02 * index, 0.0]))


def write_folder(folder: Path) -> None:
    """The toolkit's own layout, with labels and times."""
    (folder / "labels").mkdir(parents=True)
    for i in range(FRAMES):
        _images(folder, f"rgb/{i}.png", f"depth/{i}.png", i, 2000)
        images.write_png(folder / f"labels/{i}.png", np.full((HEIGHT, WIDTH), i, np.uint8))
    (folder / "labels/classes.json").write_text(json.dumps(_CLASSES))
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(_INTRINSICS | {"depth_scale": 2000}))
    (folder / "timestamps.txt").write_text("".join(f"{i} {i / 10}\n" for i in range(FRAMES)))
    poses = np.array([pose(i) for i in range(FRAMES)])
    write_tum(folder / "trajectory.txt", Trajectory(np.arange(FRAMES) / 10.0, poses))


def write_nerfstudio(folder: Path) -> None:
    """`transforms.json` with depth."""
    frames = []
    for i in range(FRAMES):
        _images(folder, f"images/{i}.png", f"depths/{i}.png", i, 1000)
        names = {"file_path": f"images/{i}.png", "depth_file_path": f"depths/{i}.png"}
        frames.append({**names, "transform_matrix": (pose(i) @ _OPENGL).tolist()})
    values = {"camera_model": "OPENCV", "w": WIDTH, "h": HEIGHT, "fl_x": 30.0, "fl_y": 31.0}
    values |= {"cx": 16.0, "cy": 12.0, "k1": 0.01, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values))


def write_record3d(folder: Path) -> None:
    """A `.r3d` file."""
    import lzfse

    poses = [pose(i) @ _OPENGL for i in range(FRAMES)]
    metadata = {
        "w": 2 * HEIGHT,
        "h": 2 * WIDTH,
        "dw": HEIGHT,
        "dh": WIDTH,
        "fps": 30,
        "K": [60.0, 0, 0, 0, 62.0, 0, 24.0, 32.0, 1],
        "perFrameIntrinsicCoeffs": [[60.0, 62.0, 24.0, 32.0]] * FRAMES,
        "frameTimestamps": [5.0 + 0.04 * i for i in range(FRAMES)],
        "poses": [[*se3.quaternion_xyzw(T[:3, :3]), *T[:3, 3]] for T in poses],
    }
    with zipfile.ZipFile(folder / "walk.r3d", "w") as archive:
        for i in range(FRAMES):
            jpeg = cv2.imencode(".jpg", np.full((WIDTH * 2, HEIGHT * 2, 3), 10 * i, np.uint8))[1]
            archive.writestr(f"rgbd/{i}.jpg", jpeg.tobytes())
            depth = depth_m(i).T.astype(np.float32)
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(depth.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", lzfse.compress(bytes([2]) * depth.size))
        archive.writestr("metadata", json.dumps(metadata))


def write_colmap(folder: Path) -> None:
    """A binary model of COLMAP."""
    model = folder / "sparse/0"
    model.mkdir(parents=True)
    content = struct.pack("<Q", FRAMES)
    for i in range(FRAMES):
        _images(folder, f"images/{i}.png", None, i, 1)
        T = se3.inverse(pose(i))
        x, y, z, w = se3.quaternion_xyzw(T[:3, :3])
        content += struct.pack("<I7dI", i + 1, w, x, y, z, *T[:3, 3], 1) + f"{i}.png\0".encode()
        content += struct.pack("<Q2dq", 1, 1.5, 2.5, -1)
    (model / "images.bin").write_bytes(content)
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 30, 31, 16, 12)
    (model / "cameras.bin").write_bytes(camera)


def _images(folder: Path, colour: str, depth: str | None, index: int, per_m: int) -> None:
    for name in filter(None, (colour, depth)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    images.write_rgb(folder / colour, rgb(index))
    if depth:
        images.write_depth_png(folder / depth, depth_m(index), per_m)
