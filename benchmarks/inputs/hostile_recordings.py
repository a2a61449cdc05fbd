"""Small valid recordings in every layout, to be damaged."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from toolkit.base.geometry import se3
from toolkit.io import images

FRAMES, WIDTH, HEIGHT = 2, 32, 24
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_CLASSES = {
    "void": 0,
    "classes": {"1": "wall", "2": "chair"},
    "colours": {"1": [9, 9, 9], "2": [200, 0, 0]},
}
Array = NDArray[np.floating]


def rgb(index: int, scale: int = 1) -> Array:
    """Random colours [H, W, 3]."""
    values = np.random.default_rng(index).uniform(size=(HEIGHT, WIDTH, 3))
    return np.kron(values, np.ones((scale, scale, 1)))


def depth_m(index: int, scale: int = 1) -> Array:
    """A slanted plane [H, W]."""
    values = np.tile(np.linspace(1.0, 2.0, WIDTH), (HEIGHT, 1)) + 0.1 * index
    return np.kron(values, np.ones((scale, scale)))


def pose(index: int) -> NDArray[np.float64]:
    """A moving and turning camera [4, 4]."""
    return se3.exp(np.array([0.1 * index, 0.0, 0.05 * index, 0.0, 0.02 * index, 0.0]))


def tum_line(time_s: float, T: NDArray[np.float64]) -> str:
    values = [time_s, *T[:3, 3], *se3.quaternion_xyzw(T[:3, :3])]
    return " ".join(map(str, values))


def write_folder(folder: Path) -> None:
    """The toolkit's own layout, with labels and times."""
    for i in range(FRAMES):
        _images(folder, f"rgb/{i}.png", f"depth/{i}.png", i, 2000)
        _labels(folder / f"labels/{i}.png", i)
    _classes(folder)
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(_intrinsics() | {"depth_scale": 2000}))
    (folder / "timestamps.txt").write_text("".join(f"{i} {i / 10}\n" for i in range(FRAMES)))
    lines = [tum_line(i / 10, pose(i)) for i in range(FRAMES)]
    (folder / "trajectory.txt").write_text("\n".join(lines))


def write_replica(folder: Path) -> None:
    """Replica and synthetic rooms."""
    for i in range(FRAMES):
        _images(folder, f"results/frame{i:06d}.jpg", f"results/depth{i:06d}.png", i, 1000)
        _labels(folder / f"labels/label{i:06d}.png", i)
    _classes(folder)
    np.savetxt(folder / "traj.txt", np.array([pose(i).ravel() for i in range(FRAMES)]))
    names = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": names | {"scale": 1000.0}}))


def write_tum(folder: Path) -> None:
    """TUM's lists, with intrinsics of another camera."""
    lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i in range(FRAMES):
        time_s = 1341840000.0 + 0.1 * i
        _images(folder, f"rgb/{time_s:.6f}.png", f"depth/{time_s:.6f}.png", i, 5000)
        for kind in ("rgb", "depth"):
            lists[kind].append(f"{time_s:.6f} {kind}/{time_s:.6f}.png")
        lists["groundtruth"].append(tum_line(time_s, pose(i)))
    for kind, lines in lists.items():
        (folder / f"{kind}.txt").write_text("# comment\n" + "\n".join(lines) + "\n")
    (folder / "intrinsics.yaml").write_text(yaml.safe_dump(_intrinsics() | {"depth_scale": 5000}))


def write_seven_scenes(folder: Path) -> None:
    """7-Scenes."""
    for i in range(FRAMES):
        stem = f"frame-{i:06d}"
        _images(folder, f"{stem}.color.png", f"{stem}.depth.png", i, 1000)
        np.savetxt(folder / f"{stem}.pose.txt", pose(i))


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


def write_stray_scanner(folder: Path) -> None:
    """A film with depth and confidence."""
    _film(folder / "rgb.mp4", FRAMES)
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(FRAMES):
        _images(folder, None, f"depth/{i:06d}.png", i, 1000)
        _png(folder / f"confidence/{i:06d}.png", np.full((HEIGHT, WIDTH), 2, np.uint8))
        rows.append(f"{100 + i / 60}, {i:06d}, " + tum_line(0, pose(i))[2:].replace(" ", ", "))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera_matrix.csv").write_text("120, 0, 64\n0, 124, 48\n0, 0, 1\n")


def write_polycam(folder: Path) -> None:
    """Raw data of Polycam."""
    for i in range(FRAMES):
        stem = f"{9_900_000 + i}"
        names = f"keyframes/images/{stem}.jpg", f"keyframes/depth/{stem}.png"
        _images(folder, *names, i, 1000, scale=2)
        confidence = np.full((HEIGHT, WIDTH), 255, np.uint8)
        _png(folder / f"keyframes/confidence/{stem}.png", confidence)
        T = pose(i) @ _OPENGL
        values: dict[str, Any] = {f"t_{r}{c}": T[r, c] for r in range(3) for c in range(4)}
        values |= {"fx": 60.0, "fy": 62.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48}
        (folder / "keyframes/cameras").mkdir(exist_ok=True)
        (folder / f"keyframes/cameras/{stem}.json").write_text(json.dumps(values))


def write_record3d(folder: Path) -> None:
    """A `.r3d` file."""
    import lzfse

    frames = range(FRAMES)
    with zipfile.ZipFile(folder / "walk.r3d", "w") as archive:
        for i in frames:
            jpeg = cv2.imencode(".jpg", np.full((WIDTH * 2, HEIGHT * 2, 3), 10 * i, np.uint8))[1]
            archive.writestr(f"rgbd/{i}.jpg", jpeg.tobytes())
            depth = depth_m(i).T.astype(np.float32)
            archive.writestr(f"rgbd/{i}.depth", lzfse.compress(depth.tobytes()))
            archive.writestr(f"rgbd/{i}.conf", lzfse.compress(bytes([2]) * depth.size))
        archive.writestr("metadata", json.dumps(_record3d_metadata()))


def colmap_writer(binary: bool) -> Callable[[Path], None]:
    """Writes a model in binary or in text."""

    def write(folder: Path) -> None:
        model = folder / "sparse/0"
        model.mkdir(parents=True)
        rows, packed = [], struct.pack("<Q", FRAMES)
        for i in range(FRAMES):
            _images(folder, f"images/{i}.png", None, i, 1)
            T = se3.inverse(pose(i))
            x, y, z, w = se3.quaternion_xyzw(T[:3, :3])
            values = [i + 1, w, x, y, z, *T[:3, 3], 1]
            rows.append(" ".join(map(str, [*values, f"{i}.png"])) + "\n1.5 2.5 -1\n")
            packed += struct.pack("<I7dI", *values) + f"{i}.png\0".encode()
            packed += struct.pack("<Q2dq", 1, 1.5, 2.5, -1)
        if binary:
            (model / "images.bin").write_bytes(packed)
            camera = struct.pack("<QiiQQ4d", 1, 1, 1, WIDTH, HEIGHT, 30, 31, 16, 12)
            (model / "cameras.bin").write_bytes(camera)
        else:
            (model / "images.txt").write_text("".join(rows))
            (model / "cameras.txt").write_text(f"1 PINHOLE {WIDTH} {HEIGHT} 30 31 16 12\n")

    return write


def bag_writer(storage: str) -> Callable[[Path], None]:
    """Writes a bag of ROS 1, or of ROS 2 in a storage."""

    def write(folder: Path) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        is_first = storage == "ros1"
        store = get_typestore(Stores.ROS1_NOETIC if is_first else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        path = folder / ("recording.bag" if is_first else "recording")
        writer: Any = Writer1(path) if is_first else Writer2(path, version=8, storage_plugin=plugin)
        pack = store.serialize_ros1 if is_first else store.serialize_cdr
        with writer:
            connections: dict[str, Any] = {}
            for topic, time_s, message in _messages(store.types, {"seq": 0} if is_first else {}):
                kind = message.__msgtype__
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=store)
                writer.write(connections[topic], round(1e9 * time_s), pack(message, kind))

    return write


def _messages(
    types: Mapping[str, Any], numbered: Mapping[str, int]
) -> list[tuple[str, float, Any]]:
    """Camera info, colour as PNG, and raw depth."""

    def header(time_s: float) -> Any:
        stamp = types["builtin_interfaces/msg/Time"](sec=int(time_s), nanosec=0)
        return types["std_msgs/msg/Header"](**numbered, stamp=stamp, frame_id="camera")

    zero = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
    matrices = {
        "d": np.zeros(5),
        "k": np.array([30.0, 0, 15.5, 0, 31, 11.5, 0, 0, 1]),
        "r": np.eye(3).ravel(),
        "p": np.eye(3, 4).ravel(),
    }
    info = types["sensor_msgs/msg/CameraInfo"](
        header=header(1),
        height=HEIGHT,
        width=WIDTH,
        distortion_model="plumb_bob",
        **{name.upper() if numbered else name: values for name, values in matrices.items()},
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](**zero, do_rectify=False),
    )
    found: list[tuple[str, float, Any]] = [("/camera/color/camera_info", 1.0, info)]
    for i in range(FRAMES):
        png = cv2.imencode(".png", (255 * rgb(i)).astype(np.uint8))[1].ravel()
        form = "rgb8; png compressed bgr8"
        packed = types["sensor_msgs/msg/CompressedImage"](
            header=header(2.0 + i), format=form, data=png
        )
        found.append(("/camera/color/image_raw/compressed", 2.0 + i, packed))
        raw = types["sensor_msgs/msg/Image"](
            header=header(2.0 + i),
            height=HEIGHT,
            width=WIDTH,
            encoding="16UC1",
            is_bigendian=0,
            step=2 * WIDTH,
            data=(1000 * depth_m(i)).astype("<u2").view(np.uint8).ravel(),
        )
        found.append(("/camera/aligned_depth_to_color/image_raw", 2.0 + i, raw))
    return found


def _record3d_metadata() -> dict[str, Any]:
    poses = [pose(i) @ _OPENGL for i in range(FRAMES)]
    return {
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


def _intrinsics() -> dict[str, Any]:
    names = {"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "width": WIDTH, "height": HEIGHT}
    return names | {"fps": 10.0, "distortion": [0.01, 0.0, 0.0, 0.0, 0.0]}


def _images(
    folder: Path, colour: str | None, depth: str | None, index: int, per_m: int, scale: int = 1
) -> None:
    for name in filter(None, (colour, depth)):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
    if colour:
        images.write_rgb(folder / colour, rgb(index, scale))
    if depth:
        images.write_depth_png(folder / depth, depth_m(index), per_m)


def _labels(path: Path, index: int) -> None:
    _png(path, np.full((HEIGHT, WIDTH), index % 3, np.uint8))


def _png(path: Path, values: NDArray[np.uint8]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    images.write_png(path, values)


def _classes(folder: Path) -> None:
    (folder / "labels/classes.json").write_text(json.dumps(_CLASSES))


def _film(path: Path, frames: int) -> None:
    size = 4 * WIDTH, 4 * HEIGHT
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 60.0, size)
    for i in range(frames):
        writer.write((255 * rgb(i, 4)).astype(np.uint8))
    writer.release()
