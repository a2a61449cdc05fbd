"""Registration check: registered, shifted, mirrored and mispaired images."""

import dataclasses

import cv2
import numpy as np
import pytest

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.findings import quick_findings
from toolkit.datasets.registration_check import (
    RegistrationReport,
    depth_edges,
    measure_registration,
)
from toolkit.datasets.registry import open_dataset
from toolkit.io import images

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)


def scene(seed: int, offset_px: tuple[int, int] = (0, 0)) -> Frame:
    """Coloured boxes in front of a textured wall, with depth shifted by an offset."""
    rng = np.random.default_rng(seed)
    texture = cv2.GaussianBlur(rng.uniform(size=(240, 320, 3)).astype(np.float32), (0, 0), 2)
    rgb, depth_m = texture, np.full((240, 320), 3.0, np.float32)
    for _ in range(12):
        x, y = rng.integers(10, 260), rng.integers(10, 190)
        w, h = rng.integers(20, 60, 2)
        rgb[y : y + h, x : x + w] = rng.uniform(size=3)
        depth_m[y : y + h, x : x + w] = rng.uniform(1.0, 2.5)
    depth_m = np.roll(depth_m, offset_px, axis=(1, 0))
    return Frame(seed, float(seed), rgb, depth_m, CAMERA)


def test_registered_images_pass():
    report = measure_registration([scene(i) for i in range(5)])
    assert report.verdict() is None
    np.testing.assert_array_equal(report.shift_px[0], 0)


@pytest.mark.parametrize("offset", [(6, 0), (0, -8), (-9, 9)])
def test_shift_is_detected_and_reported(offset):
    report = measure_registration([scene(i, offset) for i in range(5)])
    np.testing.assert_allclose(report.shift_px[0], [-offset[0], -offset[1]], atol=1)
    assert "colour is shifted relative to depth by (" in report.verdict()


@pytest.mark.parametrize("zoom", [0.94, 1.05, 1.1])
def test_wrong_focal_length_is_detected(zoom):
    M = np.float32([[zoom, 0, 160 * (1 - zoom)], [0, zoom, 120 * (1 - zoom)]])
    frames = [
        dataclasses.replace(
            f, depth_m=cv2.warpAffine(f.depth_m, M, (320, 240), flags=cv2.INTER_NEAREST)
        )
        for f in map(scene, range(6))
    ]
    assert "for any shift" in measure_registration(frames).verdict()


def test_mispaired_images_are_detected():
    pairs = [(scene(i), scene(i + 100)) for i in range(5)]
    frames = [dataclasses.replace(a, depth_m=b.depth_m) for a, b in pairs]
    assert "do not agree for any shift" in measure_registration(frames).verdict()


def small_report(**values) -> RegistrationReport:
    """What 24 registered frames of a fast walk through noisy rooms give at 160x120."""
    measured = {
        "shift_px": np.array([[1.0, -0.5], [0.5, 1.0], [0.0, -1.0], [1.0, -1.5], [-1.0, -2.5]]),
        "prominence": np.array([2.3, 2.5, 2.7, 2.4, 2.4]),
        "advantage": np.array([0.13, 0.14, 0.09, 0.31, 0.5]),
        "near_zero": 1.14,
        "edge_pixels": 24614,
        "width": 160,
    }
    return RegistrationReport(**{**measured, **values})


def test_blurred_images_pass_if_each_frame_correlates_near_zero_shift():
    assert small_report().verdict() is None
    assert small_report(width=320).verdict() is None
    assert "do not agree" in small_report(near_zero=0.9).verdict()
    shifted = {"shift_px": np.full((5, 2), 4.0), "advantage": np.full(5, 0.5)}
    clear = np.array([2.3, 3.4, 3.4, 2.4, 2.4])
    assert "do not agree" in small_report(prominence=clear, **shifted).verdict()


def test_edges_in_two_quarters_of_the_image_are_no_evidence():
    assert "do not agree" in small_report(near_zero=0.4, parts=3).verdict()
    assert small_report(near_zero=0.4, parts=2).verdict() is None


def test_a_quarter_that_clearly_agrees_contradicts_a_shift_of_the_image():
    # The first 50 frames of a corridor, whose panels have joints beside a door.
    values = {
        "shift_px": np.array(
            [[-4.0, -6.0], [-16.0, -16.0], [-4.0, -6.0], [0.0, 1.0], [-3.0, -8.0]]
        ),
        "prominence": np.array([3.05, 0.0, 2.59, 3.77, 2.4]),
        "advantage": np.array([0.59, 0.0, 0.14, 0.01, 1.13]),
        "width": 320,
    }
    assert small_report(**values).verdict() is None
    values["prominence"] = np.array([3.05, 0.0, 2.59, 2.77, 2.4])
    assert "(-4, -6)" in small_report(**values).verdict()


def test_single_pixels_of_noise_are_no_contours():
    noisy = []
    for i in range(24):
        frame = scene(i)
        depth_m = np.full_like(frame.depth_m, 3.0)
        far = np.random.default_rng(i).random(depth_m.shape) < 0.001
        noisy.append(dataclasses.replace(frame, depth_m=np.where(far, 4.0, depth_m)))
    report = measure_registration(noisy)
    assert report.edge_pixels == 0 and report.verdict() is None


def test_shift_of_two_pixels_of_a_small_image_is_no_finding():
    clear = {"prominence": np.full(5, 3.4), "advantage": np.full(5, 0.4)}
    shifted = np.tile([2.0, -1.0], (5, 1))
    assert small_report(shift_px=shifted, **clear).verdict() is None
    assert "shifted" in small_report(shift_px=1.5 * shifted, **clear).verdict()


def test_frames_correlate_near_zero_shift_if_they_are_registered():
    frames = [scene(i) for i in range(5)]
    paired = [dataclasses.replace(f, depth_m=scene(i + 50).depth_m) for i, f in enumerate(frames)]
    assert measure_registration(frames).near_zero > 3.0
    assert measure_registration(paired).near_zero < 1.5


def test_scene_without_edges_has_no_verdict():
    wall = dataclasses.replace(scene(0), depth_m=np.full((240, 320), 2.0, np.float32))
    assert measure_registration([wall]).verdict() is None
    assert measure_registration([]).verdict() is None


def test_edges_are_on_the_near_side_even_next_to_missing_depth():
    depth_m = np.full((20, 30), 4.0, np.float32)
    depth_m[5:15, 10:20] = 1.0
    depth_m[5:15, 6:10] = 0.0  # occluded from the infrared projector
    edges = depth_edges(depth_m)
    assert edges[5:15, 10].all()
    assert edges[5:15, 19].all()
    assert edges[:, :10].sum() == 0
    assert edges[:, 20:].sum() == 0


@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("tum", "tum_fr1_rpy"),
        ("replica", "replica_office0"),
        ("seven-scenes", "7scenes_redkitchen"),
    ],
)
def test_real_recordings_registered_and_shifted_by_12_pixels(real_data, kind, name):
    dataset = open_dataset(kind, real_data(name))
    frames = [dataset[int(i)] for i in np.linspace(0, len(dataset) - 1, 5)]
    assert measure_registration(frames).verdict() is None
    moved = [dataclasses.replace(f, depth_m=np.roll(f.depth_m, 12, axis=1)) for f in frames]
    report = measure_registration(moved)
    assert "shifted" in report.verdict()
    np.testing.assert_allclose(report.shift_px[0], [-12, 0], atol=2.5)


def test_findings_of_a_run_name_a_shift(tmp_path):
    folder = tmp_path / "shifted"
    for i in range(5):
        frame = scene(i, (10, 0))
        (folder / "rgb").mkdir(parents=True, exist_ok=True)
        (folder / "depth").mkdir(exist_ok=True)
        images.write_rgb(folder / f"rgb/{i}.png", frame.rgb)
        images.write_depth_png(folder / f"depth/{i}.png", frame.depth_m, 1000.0)
    values = {name: getattr(CAMERA, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    lines = [f"{name}: {value}" for name, value in (values | {"depth_scale": 1000.0}).items()]
    (folder / "intrinsics.yaml").write_text("\n".join(lines))
    (finding,) = quick_findings([*open_dataset("folder", folder)], 1000.0)
    assert finding.startswith("colour is shifted relative to depth by (-10, +0) px")
