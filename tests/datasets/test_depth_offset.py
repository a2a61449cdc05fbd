"""Offset of colour from depth: estimated from edges, and removed."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.checks import check_recording
from toolkit.datasets.depth_offset import estimate_depth_offset
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.registry import describe, open_dataset
from toolkit.datasets.resize import ImageGrid

# Scenes are drawn this many times larger, so that offsets can be fractions of a pixel.
FINE = 10
CAMERA = Camera(300.0, 300.0, 79.5, 59.5, 160, 120)
SIZE = CAMERA.size


def scene(seed: int, offset_px: tuple[float, float] = (0.0, 0.0), larger_px: float = 0.0) -> Frame:
    """Coloured boxes in front of a textured wall.

    Args:
        offset_px: of colour from depth.
        larger_px: by which boxes are larger in the depth image, on each side.
    """
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.uniform(size=(*SIZE[::-1], 3)).astype(np.float32), (0, 0), 2)
    size = FINE * np.array(SIZE)
    rgb = cv2.resize(texture, size.tolist(), interpolation=cv2.INTER_LINEAR)
    depth_m = np.full(rgb.shape[:2], 3.0, np.float32)
    move, grow = np.round(FINE * np.array(offset_px)).astype(int), round(FINE * larger_px)
    for _ in range(10):
        x, y = (rng.integers(5 * FINE, s - 35 * FINE) for s in size)
        w, h = rng.integers(10 * FINE, 30 * FINE, 2)
        rgb[y + move[1] : y + h + move[1], x + move[0] : x + w + move[0]] = rng.uniform(size=3)
        depth_m[y - grow : y + h + grow, x - grow : x + w + grow] = rng.uniform(1.0, 2.5)
    rgb = cv2.resize(rgb, SIZE, interpolation=cv2.INTER_AREA)
    # The pixel of the depth image is a ray through its middle.
    return Frame(seed, float(seed), rgb, depth_m[FINE // 2 :: FINE, FINE // 2 :: FINE], CAMERA)


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.5, -0.8), (-1.5, 2.3)])
def test_offsets_are_found_to_a_fraction_of_a_pixel(offset):
    found = estimate_depth_offset([scene(i, offset) for i in range(8)])
    assert found.fault is None
    np.testing.assert_allclose([found.x_px, found.y_px], offset, atol=0.2)
    assert found.sigma_px < 0.2


def test_objects_that_the_sensor_enlarges_cause_no_offset():
    found = estimate_depth_offset([scene(i, larger_px=1.0) for i in range(8)])
    np.testing.assert_allclose([found.x_px, found.y_px], 0.0, atol=0.2)
    np.testing.assert_allclose(found.enlarged_px, 1.0, atol=0.3)


def test_a_wall_determines_nothing():
    frames = [replace(scene(i), depth_m=np.full(SIZE[::-1], 2.0, np.float32)) for i in range(4)]
    assert "0 pixels at depth edges" in str(estimate_depth_offset(frames).fault)


def test_images_that_do_not_belong_together_determine_nothing():
    frames = [replace(scene(i), depth_m=scene(i + 50).depth_m) for i in range(8)]
    assert estimate_depth_offset(frames).fault is not None


@pytest.mark.parametrize("size", [(40, 30), (20, 15)])
def test_depth_is_shifted_without_mixing_surfaces(size):
    """A plane keeps its equation in the coordinates of the colour image; edges stay sharp."""
    camera = Camera(50.0, 50.0, 19.5, 14.5, 40, 30)
    offset = (0.6, -1.3)
    rows, columns = np.mgrid[:30, :40].astype(np.float32)
    plane = 1.0 / (0.5 + 0.004 * columns - 0.002 * rows)
    depth_m = np.where(columns < 20, plane, 4.0 * plane).astype(np.float32)
    grid = ImageGrid(camera, size, offset)
    scale = 40 / size[0]
    y, x = np.mgrid[: size[1], : size[0]]
    x, y = (x + 0.5) * scale - 0.5 - offset[0], (y + 0.5) * scale - 0.5 - offset[1]
    expected = 1.0 / (0.5 + 0.004 * x - 0.002 * y)
    found = grid.depth(depth_m)[1:-2, 1:-1]
    x, expected = x[1:-2, 1:-1], expected[1:-2, 1:-1]
    near = np.isclose(found, expected, rtol=5e-3)
    far = np.isclose(found, 4.0 * expected, rtol=5e-3)
    assert (near | far).all()
    assert near[x < 18.5].all() and far[x > 20.5].all()


def test_pixels_beyond_the_depth_image_have_no_depth():
    camera = Camera(50.0, 50.0, 19.5, 14.5, 40, 30)
    depth = ImageGrid(camera, (40, 30), (3.0, 0.0)).depth(np.ones((30, 40), np.float32))
    assert (depth[:, :3] == 0).all()
    assert (depth[:, 3:] == 1).all()


@pytest.fixture
def recording(tmp_path):
    """A folder whose colour images are offset from depth."""
    folder = tmp_path / "mine"
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    for i in range(8):
        frame = scene(i, (1.2, -0.6))
        rgb = np.round(255 * frame.rgb[..., ::-1]).astype(np.uint8)
        cv2.imwrite(str(folder / "rgb" / f"{i:03d}.png"), rgb)
        depth = np.round(1000 * frame.depth_m).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{i:03d}.png"), depth)
    camera = {"fx": 300.0, "fy": 300.0, "cx": 79.5, "cy": 59.5, "width": 160, "height": 120}
    (folder / "intrinsics.yaml").write_text(json.dumps(camera | {"depth_scale": 1000}))
    return folder


def test_auto_estimates_the_offset_of_a_dataset(recording, caplog):
    with caplog.at_level("INFO"):
        dataset = open_dataset("folder", recording, options=DatasetOptions(depth_offset="auto"))
    assert "depth is shifted by (+1." in caplog.text
    np.testing.assert_allclose(dataset.recording.depth_offset_px, (1.2, -0.6), atol=0.2)
    # Edges move by whole pixels, because surfaces are not mixed.
    left = estimate_depth_offset(dataset)
    np.testing.assert_allclose([left.x_px, left.y_px], 0.0, atol=0.55)


def test_a_stated_offset_is_used(recording):
    dataset = open_dataset("folder", recording, options=DatasetOptions(depth_offset=(2.0, 0.0)))
    shifted = np.roll(open_dataset("folder", recording)[0].depth_m, 2, axis=1)
    np.testing.assert_allclose(dataset[0].depth_m[:, 2:], shifted[:, 2:])


def test_check_data_notes_the_offset(recording):
    (note,) = (n for n in check_recording(describe("folder", recording)).notes if "offset" in n)
    assert "--dataset.depth-offset auto" in note


def test_an_undetermined_offset_is_reported_and_not_removed(recording, caplog):
    for path in (recording / "depth").iterdir():
        cv2.imwrite(str(path), np.full((120, 160), 2000, np.uint16))
    dataset = open_dataset("folder", recording, options=DatasetOptions(depth_offset="auto"))
    assert "not determined (there are only 0 pixels" in caplog.text
    assert dataset.recording.depth_offset_px == (0.0, 0.0)
