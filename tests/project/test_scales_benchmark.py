"""How `benchmarks.scales` chooses the cameras of its views."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import scales
from toolkit.base.geometry.camera import Camera

_CAMERA = Camera(60.0, 60.0, 39.5, 29.5, 80, 60)


@pytest.mark.parametrize("scale", scales.SCALES)
def test_every_scale_has_the_same_view(scale: float) -> None:
    camera = scales.scaled(_CAMERA, scale)
    assert (camera.width, camera.height) == (80 * scale, 60 * scale)
    corners = np.array([[-0.5, -0.5], [79.5, 59.5]])
    rays = (corners - [_CAMERA.cx, _CAMERA.cy]) / [_CAMERA.fx, _CAMERA.fy]
    uv = camera.project(np.column_stack([rays, np.ones(2)]))
    np.testing.assert_allclose(
        uv, [[-0.5, -0.5], [camera.width - 0.5, camera.height - 0.5]], atol=1e-6
    )


def test_the_camera_comes_nearer_without_passing_the_surface() -> None:
    depth_m = np.full((60, 80), 4.0, np.float32)
    depth_m[29:31, 39:41] = 3.0
    depth_m[0, 0] = 1.0
    assert scales.middle_depth_m(depth_m) == 3.0
    assert scales.middle_depth_m(np.zeros((60, 80), np.float32)) == 0.0


def test_targets_compare_with_spheres() -> None:
    rows = {
        f"room, {shape}": [{"scale 3": psnr, "scale 0.25": 30.0, scales.NEARER_COLUMN: psnr}]
        for shape, psnr in (("spheres", 25.0), ("ellipsoids", 28.5))
    }
    found = {target.label: (target.value, target.met) for target in scales.targets(rows)}
    assert found["room, scale 3, dB more"] == (3.5, True)
    assert found["room, scale 0.25, dB more"] == (0.0, True)
    assert found["room-noise, scale 3, dB more"][0] is None
