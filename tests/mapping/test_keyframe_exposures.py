"""White balance of keyframes: one reference for the map, whatever the images show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.painted_box import box_frames, path
from toolkit.base.exposure import NEUTRAL, Exposure
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.slam.mapping import keyframe_exposures
from toolkit.slam.mapping.keyframe_exposures import KeyframeExposures

POSES = path(12)
FRAMES = box_frames(POSES, 160, 120)


def keyframes(gains: np.ndarray) -> list[Keyframe]:
    """Views of the box, with gains [N, 3] of their channels."""
    return [
        Keyframe.from_frame(
            replace(frame, rgb=(frame.rgb * gain).clip(0.0, 1.0).astype(np.float32)), T
        )
        for frame, T, gain in zip(FRAMES, POSES, gains, strict=False)
    ]


def estimated(views: list[Keyframe], white_balance: bool = True) -> list[Keyframe]:
    exposures = KeyframeExposures(white_balance)
    for number, view in enumerate(views):
        exposures.estimate(view, views[:number])
    return views


def error(view: Keyframe, gain: np.ndarray) -> float:
    """Largest deviation of the hue from that of the reference, as a fraction."""
    total = np.array(view.exposure.balance) * gain
    return float(np.abs(total / total.mean() - 1.0).max())


def drift(step: float) -> np.ndarray:
    numbers = np.arange(len(FRAMES))[:, None]
    return 0.8 * np.exp(numbers * step * np.array([1.0, 0.0, -1.0]))


@pytest.mark.parametrize("step", [0.004, 0.03])
def test_drift_is_followed_even_in_steps_below_the_threshold(step):
    views = estimated(keyframes(drift(step)))
    assert views[0].exposure.balance == NEUTRAL
    assert error(views[-1], np.ones(3)) > 5 * step
    assert error(views[-1], drift(step)[-1]) < 0.004


def test_constant_white_balance_changes_nothing():
    for view in estimated(keyframes(np.ones((len(FRAMES), 3)))):
        assert view.exposure == Exposure()


def test_all_keyframes_are_adjusted_jointly():
    views = estimated(keyframes(drift(0.02)))
    wrong = replace(views[6], log_balance=np.array([0.1, 0.0, -0.1]))
    views[6] = wrong
    KeyframeExposures().adjust(views)
    assert max(error(v, g) for v, g in zip(views, drift(0.02), strict=True)) < 0.004


def test_a_red_wall_does_not_turn_the_balance():
    views = keyframes(np.ones((len(FRAMES), 3)))
    for share, view in zip(np.linspace(0.0, 1.0, len(views)), views, strict=True):
        # The wall enters from the right, until nothing else is in view.
        first = round((1.0 - share) * view.rgb.shape[2])
        view.rgb[:, :, first:] = torch.tensor([180, 12, 10], dtype=torch.uint8)[:, None, None]
    for view in estimated(views):
        # A narrow strip of the box is left in the last but one.
        assert np.abs(view.log_balance if view.log_balance is not None else 0.0).max() < 0.012
    # Where only the wall is in view, the balance stays as it was.
    np.testing.assert_allclose(views[-1].log_balance, views[-2].log_balance, rtol=0.02)


def test_the_other_side_of_a_thin_wall_is_another_surface():
    """The second camera faces the first one, at the same wall of another colour."""
    opposite = np.diag([-1.0, 1.0, -1.0, 1.0])
    opposite[2, 3] = 4.0
    rng, views = np.random.default_rng(0), []
    for number, (T, hue) in enumerate([(np.eye(4), [0.5, 0.5, 0.5]), (opposite, [0.6, 0.5, 0.4])]):
        rgb = (rng.uniform(0.8, 1.2, (120, 160, 1)) * hue).astype(np.float32)
        depth_m = np.full((120, 160), 2.0, np.float32)
        frame = replace(FRAMES[0], index=number, rgb=rgb, depth_m=depth_m)
        views.append(Keyframe.from_frame(frame, T))
    assert estimated(views)[1].exposure.balance == NEUTRAL


@pytest.mark.parametrize("brightness", [0.05, 4.0])
def test_dark_and_saturated_images_stay_neutral(brightness):
    gains = np.tile([1.0, 1.0, 0.8], (len(FRAMES), 1)) * brightness
    gains[0] = 1.0
    for view in estimated(keyframes(gains)[:4]):
        assert view.exposure.balance == NEUTRAL


def test_the_target_is_in_the_reference_of_the_first_keyframe():
    views = estimated(keyframes(drift(0.03)))
    first, last = (view.target_rgb().mean(dim=(1, 2)).numpy() for view in (views[0], views[-1]))
    observed = views[-1].rgb.numpy().mean(axis=(1, 2))
    hue, turned = last[0] / last[2], observed[0] / observed[2]
    assert hue == pytest.approx(first[0] / first[2], rel=0.05)
    assert turned > 1.5 * hue


def test_it_can_be_switched_off():
    for view in estimated(keyframes(drift(0.03)), white_balance=False):
        assert view.exposure.balance == NEUTRAL and view.log_balance is None


def test_a_checkpoint_contains_it():
    view = estimated(keyframes(drift(0.03)))[-1]
    restored = Keyframe.from_state(view.arrays(), view.values())
    assert restored.exposure == view.exposure
    np.testing.assert_array_equal(restored.log_balance, view.log_balance)
    assert view.balance_links is not None and len(view.balance_links) > 3
    np.testing.assert_array_equal(restored.balance_links, view.balance_links)


def test_exposures_are_undone_composed_and_inverted():
    rng = np.random.default_rng(0)
    image = rng.uniform(0.2, 0.6, (4, 5, 3)).astype(np.float32)
    first = Exposure(1.3, 0.02, balance=(1.1, 1.0, 0.8))
    second = Exposure(0.9, 0.0, balance=(0.9, 1.0, 1.2))
    np.testing.assert_allclose(first.undo(first.apply(image)), image, atol=1e-6)
    both = second.after(first)
    np.testing.assert_allclose(both.apply(image), second.apply(first.apply(image)), atol=1e-6)
    np.testing.assert_allclose(second.inverse().apply(second.apply(image)), image, atol=1e-6)


def gain_error(view: Keyframe, gain: float, bias: float = 0.0) -> float:
    """Largest deviation of middle grey from its value in the reference."""
    levels = np.array([0.3, 0.7])
    return float(np.abs(view.exposure.apply(gain * levels + bias) - levels).max())


def test_brightness_and_contrast_are_compared_between_images_and_not_with_the_map():
    """The tracker's estimates are those of a map that has lost half of its contrast."""
    gains = np.linspace(1.0, 0.7, len(FRAMES))
    views = keyframes(np.tile(gains[:, None], 3))
    for view in views[1:]:
        view.exposure = Exposure(0.5, 0.25)
    estimated(views)
    assert max(gain_error(v, g) for v, g in zip(views, gains, strict=True)) < 0.01


def test_constant_contrast_stays_where_some_images_are_blurred():
    views = keyframes(np.ones((len(FRAMES), 3)))
    for view in views[1::2]:
        rgb = view.rgb.to(torch.float32)[None]
        pooled = torch.nn.functional.avg_pool2d(rgb, 5, 1, 2, count_include_pad=False)
        view.rgb = pooled[0].round().to(torch.uint8)
    estimated(views)
    assert max(gain_error(view, 1.0) for view in views) < 0.02


def test_a_changed_contrast_is_followed():
    views = keyframes(np.ones((len(FRAMES), 3)))
    for view in views[4:]:
        view.rgb = (0.9 * view.rgb.to(torch.float32) + 0.03 * 255.0).round().to(torch.uint8)
    estimated(views)
    assert gain_error(views[-1], 0.9, 0.03) < 0.02


def test_a_view_of_nothing_known_keeps_the_exposure_of_the_tracker():
    views = keyframes(np.ones((len(FRAMES), 3)))[:2]
    views[1].T_map_camera = POSES[1] @ np.diag([-1.0, 1.0, -1.0, 1.0])
    views[1].exposure = Exposure(0.9)
    assert estimated(views)[1].exposure == Exposure(0.9)


def test_gain_and_bias_can_be_left_alone():
    views = keyframes(drift(0.03))
    exposures = KeyframeExposures(gains=False)
    exposures.estimate(views[1], views[:1])
    assert (views[1].exposure.gain, views[1].exposure.bias) == (1.0, 0.0)
    assert views[1].log_balance is not None


def test_colours_brighter_than_the_reference_keep_their_texture():
    views = keyframes(np.array([[1.0] * 3, [0.5] * 3]))
    estimated(views)
    assert float(views[1].target_rgb().max()) == pytest.approx(
        float(views[0].rgb.max()) / 255, rel=0.03
    )
    views[1].exposure = Exposure(4.0)
    target = views[1].target_rgb()
    assert float(target.max()) > 1.0
    np.testing.assert_allclose(target / 4.0, views[1].rgb / 255.0, atol=1e-6)


def test_a_drifting_white_balance_does_not_change_the_brightness_of_the_map():
    """The total gain of each channel undoes its drift, not only up to a common factor."""
    views = estimated(keyframes(drift(0.03)))
    first, last = views[0], views[-1]
    undone = last.exposure.apply(drift(0.03)[-1] * np.full(3, 0.5))
    np.testing.assert_allclose(undone, drift(0.03)[0] * 0.5, rtol=0.005)
    assert first.exposure == Exposure()


@pytest.mark.parametrize("name", available_instruction_sets())
def test_the_kernels_find_the_same_cells(name: str, monkeypatch: pytest.MonkeyPatch):
    old, new = (Keyframe.from_frame(FRAMES[i], POSES[i]) for i in (0, 7))
    old.depth_m[:, 100:120] = 0.0
    points = new.camera.unproject(new.depth_m.numpy())[::2, ::2].reshape(-1, 3).astype(np.float64)
    points = np.concatenate([points, -points[:10]])
    T_old_new = se3.inverse(old.T_map_camera) @ new.T_map_camera
    found = []
    for variant in (None, load_variant(name)):
        monkeypatch.setattr(keyframe_exposures, "kernels", lambda variant=variant: variant)
        found.append(keyframe_exposures._common_cells(old, 2, points, T_old_new))
    expected, cells = found
    assert 0.3 < (expected >= 0).mean() < 0.99
    # Rounding may move a point on the border of a pixel into the next one.
    assert (expected == cells).mean() > 0.998
