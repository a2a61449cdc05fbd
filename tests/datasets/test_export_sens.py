"""Export of a tiny .sens file to frames in ScanNet's layout."""

import importlib.util
import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.base.geometry import se3
from toolkit.datasets.registry import open_dataset

SCRIPT = Path(__file__).parents[2] / "data_tools" / "export_sens.py"


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("export_sens", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look up their module there
    spec.loader.exec_module(module)
    return module


def depth_of(i: int) -> np.ndarray:
    return (1000 + 10 * np.arange(48).reshape(6, 8) + i).astype(np.uint16)


def sens_bytes(frames: int, version: int = 4) -> bytes:
    K = np.eye(4, dtype=np.float32)
    K[0, 0] = K[1, 1] = 10
    parts = [struct.pack("<IQ", version, 4), b"test"]
    parts += [K.tobytes(), np.eye(4, dtype=np.float32).tobytes()] * 2
    parts += [struct.pack("<2i4If", 2, 1, 16, 12, 8, 6, 1000.0), struct.pack("<Q", frames)]
    for i in range(frames):
        colour = np.full((12, 16, 3), 20 * i, np.uint8)
        jpeg = cv2.imencode(".jpg", colour)[1].tobytes()
        depth = zlib.compress(depth_of(i).tobytes())
        T = se3.exp(np.full(6, 0.1 * i)) if i != 2 else np.full((4, 4), -np.inf)
        parts += [T.astype(np.float32).tobytes()]
        parts += [struct.pack("<4Q", i, i, len(jpeg), len(depth)), jpeg, depth]
    return b"".join(parts)


def test_exported_frames_are_readable_as_scannet(tool, tmp_path):
    (tmp_path / "scene.sens").write_bytes(sens_bytes(5))
    assert tool.main([str(tmp_path / "scene.sens"), str(tmp_path / "scene")]) == 0
    dataset = open_dataset("scannet", tmp_path / "scene")
    assert len(dataset) == 5
    assert dataset.camera.fx == 10
    assert dataset.camera.size == (8, 6)
    np.testing.assert_allclose(dataset[3].depth_m, depth_of(3) / 1000)
    np.testing.assert_allclose(dataset[3].rgb, 60 / 255, atol=0.01)
    assert len(dataset.ground_truth) == 4
    np.testing.assert_allclose(
        dataset.ground_truth.T_world_camera[1], se3.exp(np.full(6, 0.1)), atol=1e-6
    )


def test_every_second_frame_keeps_its_number(tool, tmp_path):
    (tmp_path / "scene.sens").write_bytes(sens_bytes(7))
    options = tool.ExportOptions(tmp_path / "scene.sens", tmp_path / "scene", 2, 3)
    assert tool.export(options) == 3
    assert sorted(f.name for f in (tmp_path / "scene/depth").iterdir()) == [
        "0.png",
        "2.png",
        "4.png",
    ]


def test_truncated_and_other_files_raise(tool, tmp_path):
    path = tmp_path / "scene.sens"
    path.write_bytes(sens_bytes(3)[:-50])
    with pytest.raises(FormatError, match=r"scene\.sens is truncated"):
        tool.export(tool.ExportOptions(path, tmp_path / "out"))
    path.write_bytes(sens_bytes(3, version=3))
    with pytest.raises(FormatError, match="version 4"):
        tool.export(tool.ExportOptions(path, tmp_path / "out"))
