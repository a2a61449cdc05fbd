"""Sensor effects: each one separately, and reproducibility."""

from dataclasses import fields

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.synthetic_rooms.ray_casting import RayCastView
from toolkit.datasets.synthetic_rooms.sensor import Sensor, SensorModel

CAMERA = Camera(100.0, 100.0, 79.5, 59.5, 160, 120)
EFFECTS = [effect.name for effect in fields(SensorModel)]


def _only(*names):
    return SensorModel(**{effect: effect in names for effect in EFFECTS})


def _view(depth_m=2.0, cosine=1.0):
    rng = np.random.default_rng(3)
    shape = (CAMERA.height, CAMERA.width)
    labels = np.full(shape, 93, dtype=np.int32)
    labels[:, 80:] = 40
    return RayCastView(
        rng.uniform(0.2, 0.8, (*shape, 3)).astype(np.float32),
        np.full(shape, depth_m, dtype=np.float32),
        labels,
        np.full(shape, cosine, dtype=np.float32),
    )


def _observe(model, view, seed=0, index=0, poses=None):
    poses = np.tile(np.eye(4), (3, 1, 1)) if poses is None else poses
    return Sensor(model, CAMERA, poses, np.random.default_rng(seed)).observe(index, view)


def _turning(degrees):
    turn = se3.exp(np.array([0, 0, 0, 0, np.radians(degrees), 0.0]))
    return np.stack([np.eye(4), turn, turn @ turn])


def test_view_without_effects_is_unchanged():
    view = _view()
    seen = _observe(_only(), view, poses=_turning(2.0))
    np.testing.assert_array_equal(seen.rgb, view.rgb)
    np.testing.assert_array_equal(seen.depth_m, view.depth_m)
    np.testing.assert_array_equal(seen.labels, view.labels)


@pytest.mark.parametrize("depth_m", [0.6, 2.0, 4.0])
def test_axial_noise_grows_with_the_square_of_depth(depth_m):
    noise = _observe(_only("axial_noise"), _view(depth_m)).depth_m - depth_m
    sigma = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    assert noise.std() == pytest.approx(sigma, rel=0.03)
    assert abs(noise.mean()) < 4 * sigma / np.sqrt(noise.size)


def test_quantised_depth_has_few_values_near_the_true_depth():
    view = _view()
    view.depth_m[:] = np.linspace(2.0, 2.5, CAMERA.width, dtype=np.float32)
    depth = _observe(_only("quantisation"), view).depth_m
    # Steps of z^2 / (f b) / 8: 11 to 18 mm here.
    assert len(np.unique(depth)) < 50
    assert 0.004 < np.abs(depth - view.depth_m).max() < 0.01


def test_holes_are_only_at_edges_and_grazing_angles():
    view = _view()
    view.depth_m[:, 80:] = 3.0
    depth = _observe(_only("holes"), view).depth_m
    assert (depth[:, 79:81] == 0).mean() > 0.5
    assert (depth[:, :70] > 0).all()
    assert (_observe(_only("holes"), _view(cosine=0.05)).depth_m == 0).all()
    assert (_observe(_only("holes"), _view(depth_m=0.2)).depth_m == 0).all()


def test_blur_follows_the_motion():
    view = _view()
    still = _observe(_only("motion_blur"), view)
    np.testing.assert_allclose(still.rgb, view.rgb, atol=1e-5)
    blurred = _observe(_only("motion_blur"), view, poses=_turning(4.0)).rgb
    across = np.abs(np.diff(blurred, axis=1)).mean()
    along = np.abs(np.diff(blurred, axis=0)).mean()
    assert across < 0.7 * along


def test_exposure_drifts_slowly():
    poses = np.tile(np.eye(4), (60, 1, 1))
    sensor = Sensor(_only("exposure_drift"), CAMERA, poses, np.random.default_rng(0))
    view = _view()
    gains = np.array([sensor.observe(i, view).rgb.mean() / view.rgb.mean() for i in range(60)])
    assert np.ptp(gains) > 0.04
    assert np.abs(gains - 1).max() < 0.081
    assert np.abs(np.diff(gains)).max() < 0.012


def test_label_noise_changes_some_labels_and_adds_no_classes():
    view = _view()
    changed = [
        np.mean(_observe(_only("label_noise"), view, seed=seed).labels != view.labels)
        for seed in range(8)
    ]
    assert 0.001 < np.mean(changed) < 0.1
    assert set(np.unique(_observe(_only("label_noise"), view).labels)) <= {40, 93}


def test_results_are_reproducible_in_any_order():
    view, poses = _view(), _turning(1.0)
    first = Sensor(SensorModel(), CAMERA, poses, np.random.default_rng(7))
    second = Sensor(SensorModel(), CAMERA, poses, np.random.default_rng(7))
    second.observe(0, view)
    for name in ("rgb", "depth_m", "labels"):
        here, there = (getattr(s.observe(1, view), name) for s in (first, second))
        np.testing.assert_array_equal(here, there)
    other = _observe(SensorModel(), view, seed=8, index=1, poses=poses)
    assert (other.depth_m != here.astype(np.float32)).any()
