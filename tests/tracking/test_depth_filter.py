"""The filter before mapping: it takes noise from surfaces, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.slam.tracking import depth_filter
from toolkit.slam.tracking.depth_filter import DepthFilter, denoised, inverse_depth_noise

NOISE = 2e-3  # 1 / m, 8 mm at 2 m


def slanted_plane(height: int = 96, width: int = 128) -> NDArray[np.float32]:
    """A wall from 1.7 to 2.5 m: linear in inverse depth."""
    y, x = np.mgrid[:height, :width]
    return (1.0 / (0.4 + 0.0012 * x + 0.0004 * y)).astype(np.float32)


def noisy(depth_m: NDArray[np.float32], seed: int = 0) -> NDArray[np.float32]:
    """Depth with a stereo camera's noise: even in inverse depth."""
    noise = np.random.default_rng(seed).normal(scale=NOISE, size=depth_m.shape)
    return (1.0 / (1.0 / depth_m + noise)).astype(np.float32)


def test_exact_depth_comes_back_unchanged():
    depth = slanted_plane()
    depth[10:20, 30:40] = 0.0
    depth[50:] += 0.5
    np.testing.assert_array_equal(denoised(depth), depth)


def test_quantised_depth_comes_back_unchanged():
    depth = np.round(slanted_plane() * 5000) / np.float32(5000)
    np.testing.assert_array_equal(denoised(depth), depth)


@pytest.mark.parametrize("seed", range(3))
def test_noise_is_estimated(seed):
    depth = noisy(slanted_plane(), seed)
    depth[:, 60:] += 1.0  # one edge does not pass for noise
    depth[20:30, 20:30] = 0.0
    scaled = inverse_depth_noise(depth[:, :60])
    assert scaled == pytest.approx(NOISE, rel=0.2)
    assert inverse_depth_noise(noisy(slanted_plane(), seed)) == pytest.approx(NOISE, rel=0.2)


def test_noise_that_neighbours_share_is_seen():
    coarse = np.random.default_rng(0).normal(scale=NOISE, size=(24, 32))
    blotches = np.kron(coarse, np.ones((4, 4)))
    depth = (1.0 / (1.0 / slanted_plane() + blotches)).astype(np.float32)
    assert inverse_depth_noise(depth) == pytest.approx(NOISE, rel=0.2)


def test_steps_of_a_sensor_are_noise_and_go():
    # An eighth of a pixel of disparity at 580 px and 7.5 cm, as structured light has it.
    step = 0.125 / (580.0 * 0.075)
    truth = slanted_plane(240, 320)
    depth = (1.0 / (np.round(1.0 / truth / step) * step)).astype(np.float32)
    assert inverse_depth_noise(depth) > 2e-4
    left = (1.0 / denoised(depth) - 1.0 / truth)[8:-8, 8:-8]
    assert left.std() < 0.35 * (1.0 / depth - 1.0 / truth).std()


def test_nothing_measured_has_no_noise():
    assert inverse_depth_noise(np.zeros((4, 6), np.float32)) == 0.0
    assert not denoised(np.zeros((4, 6), np.float32)).any()


def test_a_tenth_of_the_noise_is_left_on_a_plane_and_no_bias():
    truth = slanted_plane()
    before, after = noisy(truth), denoised(noisy(truth))
    inner = (slice(8, -8), slice(8, -8))
    left = (1.0 / after - 1.0 / truth)[inner]
    # 289 pixels of a window: a seventeenth, where no window is refused by chance.
    assert left.std() < 0.1 * (1.0 / before - 1.0 / truth)[inner].std()
    assert abs(left.mean()) < 0.02 * NOISE


def test_a_curved_surface_stays_curved():
    x = np.tile(np.arange(128.0) - 64.0, (96, 1))
    truth = (1.0 / (0.5 + 6e-5 * x**2)).astype(np.float32)
    after = denoised(noisy(truth))
    left = (1.0 / after - 1.0 / truth)[8:-8, 8:-8]
    # Over the widest window the surface bows by twice the noise, which is then taken for none:
    # what is left of it may hide in the variance of a smaller one.
    assert abs(left.mean()) < 0.35 * NOISE
    assert left.std() < 0.4 * NOISE


def test_kernel_and_numpy_agree(module, monkeypatch):
    depth = noisy(slanted_plane())
    depth[:, 70:] += 0.2
    depth[np.random.default_rng(2).random(depth.shape) < 0.1] = 0.0
    monkeypatch.setattr(depth_filter, "kernels_for", lambda tensor: module)
    native = denoised(depth)
    monkeypatch.setattr(depth_filter, "kernels_for", lambda tensor: None)
    np.testing.assert_allclose(denoised(depth), native, rtol=1e-6)


def test_frames_may_be_smoothed_ahead_of_their_turn(room):
    frame = room.frames[0]
    rough = replace(frame, depth_m=noisy(frame.depth_m))
    smooth = denoised(rough.depth_m, rough.camera.focal)
    ahead = DepthFilter()
    prepared = ahead.prepare(rough)
    assert ahead.of(rough) is prepared
    np.testing.assert_array_equal(prepared.depth_m, smooth)
    # Asked for once only, and never in place of another frame of that number.
    ahead.prepare(rough)
    other = replace(rough, depth_m=rough.depth_m + 1.0)
    np.testing.assert_array_equal(
        ahead.of(other).depth_m, denoised(other.depth_m, other.camera.focal)
    )
    np.testing.assert_array_equal(ahead.of(rough).depth_m, smooth)


def test_a_step_stays_where_it_is():
    truth = slanted_plane()
    truth[:, 64:] += 0.3
    after = denoised(noisy(truth))
    beside = np.abs(1.0 / after - 1.0 / truth)[:, 62:66]
    # The step is 0.06 / m, thirty times the noise: any blur over it would show.
    assert beside.mean() < NOISE
    assert beside.max() < 6 * NOISE


def test_missing_stays_missing_and_does_not_bleed():
    truth = slanted_plane()
    # Blocks of three pixels, wider than the gaps that are closed.
    cells = np.random.default_rng(1).random(truth.shape) < 0.03
    holes = cv2.dilate(cells.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    depth = np.where(holes, np.float32(0), noisy(truth))
    after = denoised(depth)
    inside = cv2.erode(holes.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert inside.sum() > 100 and (after[inside] == 0).all()
    assert np.abs(1.0 / after[~holes] - 1.0 / truth[~holes]).max() < 6 * NOISE
    assert after.dtype == np.float32
