"""Whether a frame that fits badly is believed, and for how long it is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tracked_room import Room

from toolkit.alignment.data import INITIAL_SCALES, ResidualScales
from toolkit.alignment.options import HealthLimits
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.tracking.dense import DenseTracker
from toolkit.tracking.health import misfit_reason, reference_scales, relaxed_scales

LIMITS = HealthLimits()
USUAL = ResidualScales(0.02, 0.003)


@pytest.mark.parametrize(("times", "astray"), [(1.0, False), (1.7, False), (2.1, True)])
def test_both_scales_count(times, astray):
    found = ResidualScales(USUAL.intensity * times, USUAL.depth_m * times)
    assert bool(misfit_reason(LIMITS, found, USUAL)) == astray


def test_the_reason_says_how_much_worse():
    reason = misfit_reason(LIMITS, ResidualScales(0.1, 0.003), USUAL)
    assert "5.0 times worse" in reason


def test_ideal_images_may_fit_several_times_worse():
    """From nearly nothing to what a sensor's noise would leave."""
    assert not misfit_reason(LIMITS, ResidualScales(0.01, 0.0015), ResidualScales(0.002, 0.0001))


def test_lost_frames_widen_what_is_believed_a_little():
    scales = USUAL
    assert reference_scales(scales, USUAL) == USUAL
    for _ in range(20):
        scales = relaxed_scales(scales)
    most = reference_scales(scales, USUAL)
    assert misfit_reason(LIMITS, ResidualScales(7 * USUAL.intensity, 2 * USUAL.depth_m), most)
    assert not misfit_reason(LIMITS, ResidualScales(3 * USUAL.intensity, 3 * USUAL.depth_m), most)


def test_lost_frames_widen_what_alignment_begins_with_up_to_a_first_frame_s():
    scales, products = USUAL, []
    for _ in range(20):
        products.append(scales.intensity * scales.depth_m)
        scales = relaxed_scales(scales)
    assert products == sorted(products)
    assert products[1] > 1.3 * products[0]
    assert scales == INITIAL_SCALES
    assert relaxed_scales(ResidualScales(0.1, 0.02)) == ResidualScales(0.1, 0.02)


def test_a_jump_into_a_place_that_fits_badly_is_no_pose(
    room: Room, gaussians: GaussianCloud, monkeypatch: pytest.MonkeyPatch
):
    tracker = DenseTracker()
    tracker.first_pose(room.frames[0])
    good = tracker.track(room.frames[1], gaussians)
    assert not good.lost
    place = tracker.motion.last()
    elsewhere = good.T_map_camera.copy()
    elsewhere[0, 3] += 0.5
    bad = replace(good, T_map_camera=elsewhere, intensity_residual=0.08, depth_residual_m=0.0015)
    monkeypatch.setattr(tracker, "locate", lambda *arguments: bad)
    result = tracker.track(room.frames[2], gaussians)
    assert result.lost and "times worse" in result.reason
    assert np.array_equal(tracker.motion.last(), place)
    # A scene that has become harder to fit is believed in the end.
    lost = 0
    while tracker.track(room.frames[3], gaussians).lost:
        lost += 1
        assert lost < 15  # RelocalisationOptions.patience
    assert lost > 1
