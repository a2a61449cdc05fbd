"""Depth maps from files: formats, names, sizes and errors."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.base.errors import DatasetError, DependencyError, SettingsError
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.resize import ImageGrid
from toolkit.depth.depth_priors.factory import build_provider
from toolkit.depth.depth_priors.options import DepthMapOptions, DepthPriorOptions
from toolkit.depth.depth_priors.provider import DepthKind, ScaleScope
from toolkit.depth.depth_priors.providers.depth_maps import DepthMapFolder
from toolkit.io.images import write_png

SOURCE = Camera(100.0, 100.0, 39.5, 29.5, 80, 60)
STEMS = ["a", "b"]


def depth(camera: Camera = SOURCE) -> np.ndarray:
    rays = camera.rays()
    return (2.0 / (1.0 + 0.3 * rays[..., 0] + 0.5 * rays[..., 1])).astype(np.float32)


def frame(index: int = 0, camera: Camera = SOURCE) -> Frame:
    shape = (camera.height, camera.width)
    rgb = np.zeros((*shape, 3), np.float32)
    return Frame(index, float(index), rgb, np.zeros(shape, np.float32), camera)


def write(file: Path, values: np.ndarray) -> None:
    if file.suffix == ".npy":
        np.save(file, values)
    elif file.suffix == ".png":
        write_png(file, np.rint(1000.0 * values).astype(np.uint16))
    elif file.suffix == ".exr":
        exr = pytest.importorskip("OpenEXR")
        header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
        exr.File(header, {"Z": np.ascontiguousarray(values)}).write(str(file))
    else:
        assert cv2.imwrite(str(file), values)


def maps(folder: Path, **options) -> DepthMapFolder:
    return DepthMapFolder(DepthMapOptions(folder=folder, **options), STEMS, SOURCE)


@pytest.mark.parametrize("suffix", [".npy", ".png", ".tif", ".tiff", ".exr"])
def test_all_formats_have_the_same_values(tmp_path, suffix):
    write(tmp_path / f"b{suffix}", depth())
    found = maps(tmp_path, values="affine", scope="set").predict([frame(1)])
    assert found.indices == (1,)
    prior = found.priors[0]
    assert (prior.kind, prior.scope) == (DepthKind.AFFINE, ScaleScope.SET)
    assert prior.model.name == f"maps in {tmp_path}"
    image = prior.in_frame(SOURCE.size)
    assert image.known.all()
    assert np.allclose(image.values, depth(), atol=1e-3)


@pytest.mark.parametrize("size", [(80, 60), (160, 120), (40, 30)])
def test_maps_of_whole_images_are_cropped_like_the_frames(tmp_path, size):
    width, height = size
    np.save(tmp_path / "a.npy", depth(SOURCE.scaled(width / 80, height / 60, width, height)))
    cropped = ImageGrid(SOURCE, (64, 32)).camera
    image = maps(tmp_path).predict([frame(0, cropped)]).priors[0].in_frame(cropped.size)
    assert image.known.all()
    assert np.allclose(image.values, depth(cropped), rtol=0.01)


def test_maps_may_have_the_size_of_the_frames(tmp_path):
    cropped = ImageGrid(SOURCE, (64, 32)).camera
    np.save(tmp_path / "a.npy", depth(cropped))
    image = maps(tmp_path).predict([frame(0, cropped)]).priors[0].in_frame(cropped.size)
    assert np.array_equal(image.values, depth(cropped))


def test_missing_depth_is_unknown(tmp_path):
    values = depth()
    values[0], values[1], values[2] = 0.0, np.nan, -1.0
    np.save(tmp_path / "a.npy", values)
    known = maps(tmp_path).predict([frame()]).priors[0].in_frame(SOURCE.size).known
    assert not known[:3].any()
    assert known[3:].all()


def test_files_need_the_names_of_the_images(tmp_path):
    np.save(tmp_path / "c.npy", depth())
    with pytest.raises(DatasetError, match=r"expected for instance a\.npy"):
        maps(tmp_path)
    np.save(tmp_path / "a.npy", depth())
    with pytest.raises(DatasetError, match="no depth map for frame 1"):
        maps(tmp_path).predict([frame(1)])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.npy", b"nonsense", "unreadable"),
        ("a.tif", b"nonsense", "unreadable"),
        ("a.png", b"nonsense", "neither PNG nor JPEG"),
    ],
)
def test_damaged_files_are_reported(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=message) as error:
        maps(tmp_path).predict([frame()])
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros((60, 80, 3), np.float32), "one channel"),
        (np.zeros((60, 60), np.float32), "aspect ratio"),
    ],
)
def test_maps_of_another_shape_are_reported(tmp_path, values, message):
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(DatasetError, match=message):
        maps(tmp_path).predict([frame()])


def test_exr_without_its_package_has_a_remedy(tmp_path, monkeypatch):
    (tmp_path / "a.exr").write_bytes(b"")
    monkeypatch.setitem(__import__("sys").modules, "OpenEXR", None)
    with pytest.raises(DependencyError, match=r"semsplat\[depth-priors\]"):
        maps(tmp_path).predict([frame()])


def test_a_source_needs_its_folder_or_weights():
    assert build_provider(DepthPriorOptions(), STEMS, SOURCE) is None
    with pytest.raises(DatasetError, match=r"--depth-prior\.maps\.folder"):
        build_provider(DepthPriorOptions(kind="maps"), STEMS, SOURCE)
    with pytest.raises(SettingsError, match=r"--depth-prior\.model\.path"):
        build_provider(DepthPriorOptions(kind="transformers"), STEMS, SOURCE)
