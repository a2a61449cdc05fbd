"""Fixtures: tiny recordings in every layout."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_frames import HEIGHT, WIDTH, camera_file, frame_depth_m, frame_rgb, pose

from toolkit.base.geometry import se3
from toolkit.io import images


@pytest.fixture
def make_replica(tmp_path) -> Callable[..., Path]:
    """Writes a recording in Replica's layout."""

    def make(frames: int = 4, labels: bool = False, scale: float = 1000.0) -> Path:
        folder = tmp_path / "room"
        (folder / "results").mkdir(parents=True)
        for i in range(frames):
            images.write_rgb(folder / f"results/frame{i:06d}.png", frame_rgb(i))
            images.write_depth_png(folder / f"results/depth{i:06d}.png", frame_depth_m(i), scale)
        poses = np.array([pose(i).ravel() for i in range(frames)])
        np.savetxt(folder / "traj.txt", poses)
        camera = {"w": WIDTH, "h": HEIGHT, "fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5}
        (folder / "cam_params.json").write_text(json.dumps({"camera": camera | {"scale": scale}}))
        if labels:
            (folder / "labels").mkdir()
            for i in range(frames):
                ids = np.full((HEIGHT, WIDTH), i % 3, np.uint8)
                images.write_png(folder / f"labels/label{i:06d}.png", ids)
            classes = {"void": 0, "classes": {"1": "wall", "2": "chair"}}
            (folder / "labels/classes.json").write_text(json.dumps(classes))
        return folder

    return make


@pytest.fixture
def make_tum(tmp_path) -> Callable[..., Path]:
    """Writes a recording in TUM's layout; colour every 0.1 s, depth 10 ms later."""

    def make(
        frames: int = 4, name: str = "rgbd_dataset_freiburg3_test", start_s: float = 1341840000.0
    ) -> Path:
        folder = tmp_path / name
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir(parents=True)
        lists: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
        for i in range(frames):
            time = start_s + 0.1 * i
            rgb = np.kron(frame_rgb(i), np.ones((20, 20, 1)))
            depth_m = np.kron(frame_depth_m(i), np.ones((20, 20)))
            images.write_rgb(folder / f"rgb/{time:.6f}.png", rgb)
            images.write_depth_png(folder / f"depth/{time + 0.01:.6f}.png", depth_m, 5000)
            lists["rgb"].append(f"{time:.6f} rgb/{time:.6f}.png")
            lists["depth"].append(f"{time + 0.01:.6f} depth/{time + 0.01:.6f}.png")
            values = [*pose(i)[:3, 3], *se3.quaternion_xyzw(pose(i)[:3, :3])]
            lists["groundtruth"].append(f"{time + 0.004:.4f} " + " ".join(map(str, values)))
        for kind, lines in lists.items():
            (folder / f"{kind}.txt").write_text("# a comment\n" + "\n".join(lines) + "\n")
        return folder

    return make


@pytest.fixture
def make_seven_scenes(tmp_path) -> Callable[..., Path]:
    """Writes a recording in 7-Scenes' layout, with every second frame."""

    def make(frames: int = 4) -> Path:
        folder = tmp_path / "seq-01"
        folder.mkdir()
        for i in range(0, 2 * frames, 2):
            stem = folder / f"frame-{i:06d}"
            images.write_rgb(f"{stem}.color.png", frame_rgb(i))
            raw = np.round(frame_depth_m(i) * 1000).astype(np.uint16)
            raw[0, 0], raw[0, 1] = 65535, 0
            images.write_png(f"{stem}.depth.png", raw)
            np.savetxt(f"{stem}.pose.txt", pose(i))
        return folder

    return make


@pytest.fixture
def make_nerfstudio(tmp_path) -> Callable[..., Path]:
    """Writes `transforms.json` with poses in OpenGL's axes; colour is `enlarged` times as large."""

    def make(frames: int = 4, enlarged: int = 1) -> Path:
        folder = tmp_path / "poly"
        (folder / "images").mkdir(parents=True)
        (folder / "depths").mkdir()
        entries = []
        for i in range(frames):
            rgb = np.kron(frame_rgb(i), np.ones((enlarged, enlarged, 1)))
            images.write_rgb(folder / f"images/{i + 1}.png", rgb)
            images.write_depth_png(folder / f"depths/{i + 1}.png", frame_depth_m(i), 1000)
            T = pose(i)
            # Columns of the axes: right, up instead of down, back instead of forward.
            T_opengl = np.stack([T[:, 0], -T[:, 1], -T[:, 2], T[:, 3]], axis=1)
            entries.append(
                {
                    "file_path": f"./images/{i + 1}.png",
                    "depth_file_path": f"depths\\{i + 1}.png",
                    "transform_matrix": T_opengl.tolist(),
                }
            )
        content = {
            "camera_model": "OPENCV",
            "w": WIDTH * enlarged,
            "h": HEIGHT * enlarged,
            "fl_x": 30.0 * enlarged,
            "fl_y": 31.0 * enlarged,
            "cx": 16.0 * enlarged,
            "cy": 12.0 * enlarged,
            "frames": entries[::-1],
        }
        (folder / "transforms.json").write_text(json.dumps(content))
        return folder

    return make


@pytest.fixture
def make_stray_scanner(tmp_path) -> Callable[..., Path]:
    """Writes Stray Scanner's layout; video frame i has the grey level 0.1 + 0.1 i."""

    def make(frames: int = 6, video_frames: int | None = None) -> Path:
        folder = tmp_path / "71de12f9"
        for kind in ("depth", "confidence"):
            (folder / kind).mkdir(parents=True)
        size = (4 * WIDTH, 4 * HEIGHT)
        writer = cv2.VideoWriter(
            str(folder / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 60.0, size
        )
        for i in range(frames if video_frames is None else video_frames):
            grey = round(255 * (0.1 + 0.1 * i))
            writer.write(np.full((size[1], size[0], 3), grey, np.uint8))
        writer.release()
        rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
        for i in range(frames):
            images.write_depth_png(folder / f"depth/{i:06d}.png", frame_depth_m(i), 1000)
            confidence = np.full((HEIGHT, WIDTH), 2, np.uint8)
            confidence[3, 5] = 0
            images.write_png(folder / f"confidence/{i:06d}.png", confidence)
            values = [100.0 + i / 60, *pose(i)[:3, 3], *se3.quaternion_xyzw(pose(i)[:3, :3])]
            rows.append(f"{values[0]}, {i:06d}, " + ", ".join(map(str, values[1:])))
        (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
        (folder / "camera_matrix.csv").write_text("120, 0, 64\n0, 124, 48\n0, 0, 1\n")
        return folder

    return make


@pytest.fixture
def make_polycam(tmp_path) -> Callable[..., Path]:
    """Writes raw data of Polycam, whose colour is twice as large as depth."""

    def make(corrected: bool = True, frames: int = 3) -> Path:
        folder = tmp_path / "poly"
        keyframes = folder / "keyframes"
        kinds = ["", "corrected_"] if corrected else [""]
        for kind in (*(f"{k}{n}" for k in kinds for n in ("images", "cameras")), "depth"):
            (keyframes / kind).mkdir(parents=True)
        (keyframes / "confidence").mkdir()
        for i in range(frames):
            stem = str(9_900_000 + 100_000 * i)  # the second one has more digits
            for kind in kinds:
                rgb = np.kron(frame_rgb(i if kind or not corrected else 7), np.ones((2, 2, 1)))
                images.write_rgb(keyframes / f"{kind}images/{stem}.png", rgb)
                (keyframes / f"{kind}cameras/{stem}.json").write_text(camera_file(i))
            images.write_depth_png(keyframes / f"depth/{stem}.png", frame_depth_m(i), 1000)
            confidence = np.full((HEIGHT, WIDTH), 255, np.uint8)
            confidence[3, 5], confidence[3, 6] = 0, 127
            images.write_png(keyframes / f"confidence/{stem}.png", confidence)
        return folder

    return make


@pytest.fixture
def make_scannet(tmp_path) -> Callable[..., Path]:
    """Writes exported ScanNet frames; colour has twice the size of depth, frame 1 has no pose."""

    def make(frames: int = 12) -> Path:
        folder = tmp_path / "scene0000_00"
        for kind in ("color", "depth", "pose", "intrinsic"):
            (folder / kind).mkdir(parents=True)
        for i in range(frames):
            rgb = np.kron(frame_rgb(i), np.ones((2, 2, 1)))
            images.write_rgb(folder / f"color/{i}.png", rgb)
            images.write_depth_png(folder / f"depth/{i}.png", frame_depth_m(i), 1000)
            T = np.full((4, 4), -np.inf) if i == 1 else pose(i)
            np.savetxt(folder / f"pose/{i}.txt", T)
        K = np.diag([30.0, 31.0, 1.0, 1.0])
        K[:2, 2] = 15.5, 11.5
        np.savetxt(folder / "intrinsic/intrinsic_depth.txt", K)
        return folder

    return make


@pytest.fixture
def make_folder(tmp_path) -> Callable[..., Path]:
    """Writes a plain folder: rgb/, depth/, intrinsics.yaml, trajectory.txt at 10 fps."""

    def make(frames: int = 4, intrinsics: dict | None = None) -> Path:
        folder = tmp_path / "mine"
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir(parents=True)
        for i in range(frames):
            images.write_rgb(folder / f"rgb/{i}.png", frame_rgb(i))
            images.write_depth_png(folder / f"depth/{i}.png", frame_depth_m(i), 2000)
        values = {"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "width": WIDTH}
        values |= {"height": HEIGHT, "depth_scale": 2000, "fps": 10} | (intrinsics or {})
        lines = [f"{key}: {value}" for key, value in values.items() if value is not None]
        (folder / "intrinsics.yaml").write_text("\n".join(lines))
        lines = [
            f"{i / 10} " + " ".join(map(str, [*pose(i)[:3, 3], *se3.quaternion_xyzw(pose(i))]))
            for i in range(frames)
        ]
        (folder / "trajectory.txt").write_text("\n".join(lines))
        return folder

    return make
