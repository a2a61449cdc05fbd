"""Pixels between the two surfaces at a depth edge."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.datasets.synthetic_rooms.imperfections import with_flying_pixels
from toolkit.slam.tracking import flying_pixels
from toolkit.slam.tracking.depth_filter import denoised
from toolkit.slam.tracking.flying_pixels import without_flying_pixels

FOCAL = 260.0
SHAPE = (60, 80)


def box_before_wall(near_m: float = 1.0, far_m: float = 2.0) -> np.ndarray:
    depth_m = np.full(SHAPE, far_m, np.float32)
    depth_m[20:40, 25:55] = near_m
    return depth_m


def removed(depth_m: np.ndarray, noise: float = 1e-5) -> np.ndarray:
    inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=depth_m > 0)
    kept = without_flying_pixels(inverse, FOCAL, noise)
    np.testing.assert_array_equal(kept[kept > 0], inverse[kept > 0])
    return (depth_m > 0) & (kept == 0)


@pytest.mark.parametrize("wide", [1, 2])
def test_a_ramp_between_two_surfaces_goes(wide: int):
    depth_m = box_before_wall()
    ramp = np.linspace(1.0, 2.0, wide + 2)[1:-1]
    depth_m[20:40, 55 : 55 + wide] = ramp.astype(np.float32)
    mask = removed(depth_m)
    assert mask[22:38, 55 : 55 + wide].all()
    mask[18:42, 55 : 55 + wide] = False
    assert not mask.any()


def test_scattered_flying_pixels_go_and_little_else():
    true_m = box_before_wall()
    rng = np.random.default_rng(0)
    depth_m = with_flying_pixels(true_m, true_m, rng).astype(np.float32)
    flying = np.abs(depth_m - true_m) > 0.1
    mask = removed(depth_m)
    assert flying.sum() > 50
    assert mask[flying].mean() > 0.7
    assert (mask & ~flying).sum() < 0.05 * flying.sum()


@pytest.mark.parametrize("degrees", [0, 60, 75, 84])
def test_surfaces_stay_however_slanted(degrees: int):
    rows = np.mgrid[: SHAPE[0], : SHAPE[1]][0]
    # A plane whose inverse depth changes by this per pixel, with noise that grows with range.
    slope = 0.4 * np.tan(np.radians(degrees)) / FOCAL
    inverse = 0.4 + slope * (rows - 30)
    noise = 1e-3
    inverse = inverse + noise * np.random.default_rng(0).standard_normal(SHAPE)
    inverse = np.where(inverse > 0.1, inverse, 0.0).astype(np.float32)
    kept = without_flying_pixels(inverse, FOCAL, noise)
    # In the farther half of the steepest plane, the angle exceeds 85 degrees.
    measured = (inverse > 0) & (inverse > slope * FOCAL / 10.0)
    assert measured.mean() > 0.4
    assert (kept[measured] > 0).mean() > 0.999


def test_edges_and_thin_objects_stay():
    depth_m = box_before_wall()
    depth_m[:, 10] = 1.2  # a pole
    depth_m[:15, :15] = 0.0
    assert not removed(depth_m).any()


def test_the_filter_removes_them_from_frames_without_noise():
    depth_m = box_before_wall()
    depth_m[20:40, 55] = 1.5
    assert not denoised(depth_m, FOCAL)[22:38, 55].any()
    assert denoised(depth_m) is depth_m
    clean = box_before_wall()
    assert denoised(clean, FOCAL) is clean


@pytest.mark.parametrize("name", available_instruction_sets())
def test_the_kernels_remove_the_same_pixels(name: str, monkeypatch: pytest.MonkeyPatch):
    rng = np.random.default_rng(0)
    columns = np.arange(SHAPE[1], dtype=np.float32)
    true_m = box_before_wall() + np.float32(0.01) * columns
    noise = rng.normal(0.0, 0.002, SHAPE).astype(np.float32)
    depth_m = with_flying_pixels(true_m + noise * true_m**2, true_m, rng).astype(np.float32)
    depth_m[rng.random(SHAPE) < 0.05] = 0.0
    masks = []
    for variant in (None, load_variant(name)):
        monkeypatch.setattr(flying_pixels, "kernels", lambda variant=variant: variant)
        masks.append(removed(depth_m, 0.002))
    assert masks[0].any()
    np.testing.assert_array_equal(*masks)
