"""Residual scales after lost frames."""

from __future__ import annotations

from toolkit.slam.tracking.health import relaxed_scales
from toolkit.splatting.alignment.data import INITIAL_SCALES, ResidualScales


def test_scales_grow_with_lost_frames_up_to_those_of_a_first_frame():
    scales, products = ResidualScales(0.02, 0.003), []
    for _ in range(20):
        products.append(scales.intensity * scales.depth_m)
        scales = relaxed_scales(scales)
    assert products == sorted(products)
    assert products[1] > 1.3 * products[0]
    assert scales == INITIAL_SCALES
    assert relaxed_scales(ResidualScales(0.1, 0.02)) == ResidualScales(0.1, 0.02)
