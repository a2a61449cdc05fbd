"""PSNR over parts of a view, and with one gain per channel."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.runs.evaluation.images import balanced, masked_psnr_db, psnr_db
from toolkit.runs.evaluation.metrics import image_metrics, view_quality


def view() -> np.ndarray:
    return np.random.default_rng(0).uniform(0.2, 0.7, (24, 32, 3)).astype(np.float32)


def test_errors_at_pixels_without_depth_lower_their_psnr_alone():
    observed, depth_m = view(), np.ones((24, 32), np.float32)
    depth_m[:12] = 0.0
    rendered = observed + np.float32(0.01)
    rendered[:12] += np.float32(0.09)
    found = image_metrics([view_quality((rendered, depth_m), (observed, depth_m))])
    assert found["psnr_measured_db"] == pytest.approx(40.0, abs=0.01)
    assert found["psnr_inferred_db"] == pytest.approx(20.0, abs=0.01)
    assert found["psnr_db"] == pytest.approx(-10 * np.log10(0.5 * (1e-4 + 1e-2)), abs=0.01)


def test_no_pixel_has_no_psnr():
    observed = view()
    assert masked_psnr_db(observed, observed, np.zeros((24, 32), bool)) is None
    depth_m = np.ones((24, 32), np.float32)
    found = image_metrics([view_quality((observed, depth_m), (observed, depth_m))])
    assert found["psnr_inferred_db"] is None and found["psnr_measured_db"] == 100.0


def test_white_balance_is_found_beside_errors_of_the_map():
    rendered = view()
    observed = rendered * np.array([1.1, 1.0, 0.9], np.float32)
    observed[:6, :8] = 0.95
    matched = balanced(rendered, observed)
    assert psnr_db(matched[6:], observed[6:]) > 45.0 > 30.0 > psnr_db(rendered[6:], observed[6:])


def test_a_dark_channel_keeps_its_gain():
    rendered = view()
    rendered[..., 2] = 0.002
    observed = rendered.copy()
    observed[..., 2] = 0.02
    np.testing.assert_allclose(balanced(rendered, observed)[..., 2], 0.002, rtol=0.05)
