"""Recordings of Record3D: zip archives with JPEG, LZFSE depth and metadata."""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from tiny_frames import frame_depth_m, pose

from toolkit.base.errors import DatasetError, DependencyError
from toolkit.base.geometry import se3
from toolkit.datasets.registry import open_dataset

lzfse = pytest.importorskip("lzfse")

# Upright, as the app records.
WIDTH, HEIGHT, ENLARGED, FRAMES = 24, 32, 3, 12
INTRINSICS = (90.0, 93.0, 36.0, 48.0)  # of colour, from the corner of the first pixel
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def depth_of(index: int) -> np.ndarray:
    return frame_depth_m(index).T.astype(np.float32)


def content(**changes: Any) -> dict[str, bytes]:
    """Files of a recording; `changes` are of the metadata, None removes."""
    files = {}
    poses = []
    for i in range(FRAMES):
        size = (HEIGHT * ENLARGED, WIDTH * ENLARGED, 3)
        grey = np.full(size, 10 * i + 20, np.uint8)
        files[f"rgbd/{i}.jpg"] = cv2.imencode(".jpg", grey)[1].tobytes()
        depth = depth_of(i)
        depth[1, 2], depth[1, 3] = np.nan, 0.0
        files[f"rgbd/{i}.depth"] = lzfse.compress(depth.tobytes())
        confidence = np.full((HEIGHT, WIDTH), 2, np.uint8)
        confidence[3, 5] = 0
        files[f"rgbd/{i}.conf"] = lzfse.compress(confidence.tobytes())
        T = pose(i) @ OPENGL
        poses.append([*se3.quaternion_xyzw(T[:3, :3]), *T[:3, 3]])
    fx, fy, cx, cy = INTRINSICS
    metadata = {
        "w": WIDTH * ENLARGED,
        "h": HEIGHT * ENLARGED,
        "dw": WIDTH,
        "dh": HEIGHT,
        "fps": 30,
        "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1],
        "perFrameIntrinsicCoeffs": [list(INTRINSICS)] * FRAMES,
        "frameTimestamps": [5.0 + 0.04 * i for i in range(FRAMES)],
        "poses": poses,
    } | changes
    kept = {key: value for key, value in metadata.items() if value is not None}
    return files | {"metadata": json.dumps(kept).encode(), "icon": b""}


def write(folder: Path, files: dict[str, bytes] | None = None, **changes: Any) -> Path:
    path = folder / "walk.r3d"
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in (files or content(**changes)).items():
            archive.writestr(name, data)
    return path


def test_frames_camera_and_poses_are_those_written(tmp_path):
    dataset = open_dataset("record3d", write(tmp_path))
    camera = dataset.camera
    assert camera.size == (WIDTH, HEIGHT)
    assert (camera.fx, camera.fy) == pytest.approx((30.0, 31.0))
    assert (camera.cx, camera.cy) == pytest.approx((11.5, 15.5))
    np.testing.assert_allclose(dataset.timestamps_s, 5.0 + 0.04 * np.arange(FRAMES))
    for i in (11, 0, 2, 10):
        frame = dataset[i]
        assert frame.rgb.mean() == pytest.approx((10 * i + 20) / 255, abs=0.01)
        expected = depth_of(i)
        expected[1, 2:4] = expected[3, 5] = 0.0
        np.testing.assert_array_equal(frame.depth_m, expected)
        T = dataset.ground_truth.T_world_camera[i]
        np.testing.assert_allclose(T, pose(i), atol=1e-6)
    assert dataset.recording.flaws == ()
    assert dataset.recording.up_world == (0.0, 1.0, 0.0)


def test_a_point_keeps_its_place_in_the_world(tmp_path):
    """A point seen right of and above the centre, by the axes of OpenGL."""
    path = write(tmp_path)
    with zipfile.ZipFile(path) as archive:
        values = np.array(json.loads(archive.read("metadata"))["poses"][3])
    dataset = open_dataset("record3d", path)
    camera, T = dataset.camera, dataset.ground_truth.T_world_camera[3]
    u, v, z = camera.cx + camera.fx * 0.1, camera.cy - camera.fy * 0.2, 2.0
    ours = T @ [(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, 1.0]
    R = se3.rotation_from_quaternion_xyzw(values[:4])
    np.testing.assert_allclose(ours[:3], R @ [0.2, 0.4, -2.0] + values[4:], atol=1e-9)


def test_unpacked_and_single_recordings_in_a_folder_are_read(tmp_path):
    path = write(tmp_path)
    assert len(open_dataset("record3d", tmp_path)) == FRAMES
    unpacked = tmp_path / "unpacked"
    with zipfile.ZipFile(path) as archive:
        archive.extractall(unpacked)
    first = open_dataset("record3d", unpacked)[4]
    np.testing.assert_array_equal(first.depth_m, open_dataset("record3d", path)[4].depth_m)


def test_without_depth_colour_keeps_its_size(tmp_path):
    dataset = open_dataset("record3d", write(tmp_path), needs_depth=False)
    assert dataset.camera.size == (WIDTH * ENLARGED, HEIGHT * ENLARGED)
    assert (dataset.camera.fx, dataset.camera.cx) == (90.0, 35.5)
    assert dataset[0].rgb.shape == (HEIGHT * ENLARGED, WIDTH * ENLARGED, 3)


def test_early_versions_lack_sizes_intrinsics_of_frames_and_times(tmp_path):
    removed = dict.fromkeys(("dw", "dh", "perFrameIntrinsicCoeffs", "frameTimestamps"))
    dataset = open_dataset("record3d", write(tmp_path, **removed))
    assert dataset.camera.size == (WIDTH, HEIGHT)
    assert dataset.camera.fx == pytest.approx(30.0)
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(FRAMES) / 30)


def test_recordings_of_the_front_camera_have_no_poses(tmp_path):
    dataset = open_dataset("record3d", write(tmp_path, poses=[]))
    assert dataset.ground_truth is None


def test_focus_is_averaged_and_zoom_refused(tmp_path):
    rows = [list(INTRINSICS) for _ in range(FRAMES)]
    rows[0][0] *= 1.01
    dataset = open_dataset("record3d", write(tmp_path, perFrameIntrinsicCoeffs=rows))
    assert dataset.camera.fx == pytest.approx(30.0)
    assert "1.0 %" in dataset.recording.flaws[0]
    rows[0][0] *= 2
    with pytest.raises(DatasetError, match="record with fixed focus and zoom"):
        open_dataset("record3d", write(tmp_path, perFrameIntrinsicCoeffs=rows))


def test_times_that_do_not_ascend_are_replaced(tmp_path):
    dataset = open_dataset("record3d", write(tmp_path, frameTimestamps=[1.0] * FRAMES))
    np.testing.assert_allclose(dataset.timestamps_s, np.arange(FRAMES) / 30)
    assert "frameTimestamps are not ascending" in dataset.recording.flaws[0]


def test_frames_without_depth_are_left_out(tmp_path):
    files = content()
    del files["rgbd/1.depth"]
    dataset = open_dataset("record3d", write(tmp_path, files))
    assert dataset.stems[:2] == ["000000", "000002"]
    assert dataset.recording.flaws == ("1 frame(s) without depth: 1",)
    np.testing.assert_allclose(dataset.ground_truth.T_world_camera[1], pose(2), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"K": None, "perFrameIntrinsicCoeffs": None}, "K of metadata .* must have 9 numbers"),
        ({"perFrameIntrinsicCoeffs": [[1, 2]] * FRAMES}, "must have 4 numbers"),
        ({"perFrameIntrinsicCoeffs": [[-1, 2, 3, 4]] * FRAMES}, "fx, fy > 0"),
        ({"poses": [["x"]] * FRAMES}, "poses of metadata .* must have 7 numbers"),
    ],
)
def test_malformed_metadata_is_refused(tmp_path, changes, message):
    with pytest.raises(DatasetError, match=message):
        open_dataset("record3d", write(tmp_path, **changes))


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("metadata", b"{", "is not JSON"),
        ("metadata", b"[]", "is not a JSON object"),
        ("rgbd/0.jpg", b"", r"rgbd/0\.jpg in .* is damaged"),
        ("rgbd/0.depth", b"no LZFSE", r"rgbd/0\.depth in .* is damaged"),
        ("rgbd/0.depth", lzfse.compress(bytes(4 * 77)), "77 values, which fit neither"),
    ],
)
def test_damaged_files_are_named(tmp_path, name, data, message):
    with pytest.raises(DatasetError, match=message):
        open_dataset("record3d", write(tmp_path, content() | {name: data}))


def test_other_files_are_refused_in_one_line(tmp_path):
    path = write(tmp_path)
    path.write_bytes(path.read_bytes()[:5000])
    with pytest.raises(DatasetError, match=r"truncated or not a \.r3d file"):
        open_dataset("record3d", path)
    write(tmp_path, {"other.txt": b""})
    with pytest.raises(DatasetError, match="as recordings of Record3D have"):
        open_dataset("record3d", path)
    with pytest.raises(DatasetError, match="does not exist"):
        open_dataset("record3d", tmp_path / "none.r3d")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DatasetError, match=r"contains no \.r3d file"):
        open_dataset("record3d", tmp_path / "empty")


def test_a_missing_package_is_named_with_the_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(DependencyError, match=r"pip install 'semsplat\[record3d\]'"):
        open_dataset("record3d", write(tmp_path))


def test_the_export_of_exr_and_jpg_files_is_read(tmp_path):
    exr = pytest.importorskip("OpenEXR")
    folder, files = tmp_path / "EXR_RGBD", content(perFrameIntrinsicCoeffs=None)
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    (folder / "metadata.json").write_bytes(files["metadata"])
    for i in range(FRAMES):
        (folder / f"rgb/{i}.jpg").write_bytes(files[f"rgbd/{i}.jpg"])
        depth = depth_of(i)
        depth[1, 2] = np.nan
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        exr.File(header, {"R": np.ascontiguousarray(depth)}).write(str(folder / f"depth/{i}.exr"))
    exported = open_dataset("record3d", folder)
    packed = open_dataset("record3d", write(tmp_path, content(perFrameIntrinsicCoeffs=None)))
    assert len(exported) == len(packed) == FRAMES
    assert exported.camera == packed.camera
    np.testing.assert_array_equal(
        exported.ground_truth.T_world_camera, packed.ground_truth.T_world_camera
    )
    expected = depth_of(5)
    expected[1, 2] = 0.0
    np.testing.assert_array_equal(exported[5].depth_m, expected)
    np.testing.assert_array_equal(exported[5].rgb, packed[5].rgb)
    (folder / "depth/3.exr").write_bytes(b"broken")
    with pytest.raises(DatasetError, match=r"depth/3\.exr is damaged"):
        exported[3]
