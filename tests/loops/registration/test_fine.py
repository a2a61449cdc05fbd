"""Registration by rendering from nearby."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from registered_room import Scene, error, motion

from toolkit.base.geometry import se3
from toolkit.slam.loops.registration import fine
from toolkit.slam.loops.registration.fine import FineRegistration, mismatched_classes
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.splatting.alignment.joint import align


@pytest.mark.parametrize(("metres", "degrees"), [(0.0, 0.0), (0.05, 3.0), (0.1, 6.0)])
def test_dense_finds_the_motion_from_nearby(room: Scene, renderer, metres, degrees):
    start = room.T_target_source @ motion(1, metres, degrees)
    result = FineRegistration(renderer=renderer).register(room.target, room.source, start)
    mm, deg = error(result.T_target_source, room.T_target_source)
    assert result.converged, result.reason
    assert mm < 2.0
    assert deg < 0.05
    assert result.overlap > 0.8
    assert result.inliers > 0.95
    assert result.renders == renderer.renders
    assert np.linalg.eigvalsh(result.information)[0] > 0
    x = se3.log(se3.inverse(result.T_target_source) @ room.T_target_source)
    assert 0.01 < x @ result.information @ x < 12.6  # chi-square of six: 95 % lie below


@pytest.mark.parametrize(("swing_m", "rests"), [(2e-4, True), (0.02, False)])
def test_steps_that_swing_about_an_answer_have_come_to_rest(
    room: Scene, monkeypatch: pytest.MonkeyPatch, swing_m, rests
):
    """They never get small, and are less than anyone asks."""
    start = room.T_target_source

    def swinging(pairs, estimate, options, finest_only=False):
        found = align(pairs, replace(estimate, T_target_source=start), options, finest_only)
        away = np.array([swing_m * (-1.0) ** swinging.calls, 0.0, 0.0, 0.0, 0.0, 0.0])
        swinging.calls += 1
        T = found.T_target_source @ se3.exp(away)
        return replace(found, T_target_source=T, converged=False)

    swinging.calls = 0
    monkeypatch.setattr(fine, "align", swinging)
    result = FineRegistration().register(room.target, room.source, start)
    assert result.converged == rests
    assert rests or "did not converge" in result.reason


def test_both_maps_stay_as_they_are(room: Scene):
    before = [s.gaussians.means.clone() for s in (room.target, room.source)]
    FineRegistration().register(room.target, room.source, room.T_target_source)
    for submap, means in zip((room.target, room.source), before, strict=True):
        assert torch.equal(submap.gaussians.means, means)


def test_a_start_that_shows_nothing_in_common_does_not_converge(room: Scene):
    away = room.T_target_source @ se3.exp(np.array([0.0, 0.0, 30.0, 0.0, 0.0, 0.0]))
    result = FineRegistration().register(room.target, room.source, away)
    assert not result.converged
    assert "shows what the other saw" in result.reason


def test_an_empty_submap_is_nothing_to_align(room: Scene):
    none = room.source.gaussians.select(room.source.gaussians.opacities < 0)
    for part in ({"gaussians": none}, {"keyframes": []}):
        empty = replace(room.source, **part)
        result = FineRegistration().register(room.target, empty, room.T_target_source)
        assert not result.converged
        assert "no view of the one shows" in result.reason
        np.testing.assert_array_equal(result.T_target_source, room.T_target_source)
    result = FineRegistration().register(
        replace(room.target, gaussians=none), room.source, room.T_target_source
    )
    assert not result.converged
    assert "share only 0 %" in result.reason


def test_classes_clash_beyond_the_window_only():
    source, target = np.zeros((9, 9), np.int32), np.zeros((9, 9), np.int32)
    source[:, :4], source[:, 4:] = 1, 2
    target[:, :6], target[:, 6:] = 1, 2
    clash = mismatched_classes(source, target, 1)
    assert clash is not None
    assert clash[:, 4].all()  # two pixels from the nearest 2
    assert not clash[:, 5:].any()
    assert not clash[:, :4].any()
    assert not mismatched_classes(source, target, 2).any()


def test_void_and_missing_classes_clash_with_nothing():
    seen, void = np.ones((5, 5), np.int32), np.zeros((5, 5), np.int32)
    assert not mismatched_classes(seen, void, 0).any()
    assert mismatched_classes(seen, None, 0) is None


def test_pixels_of_other_classes_are_ignored(labelled_room: Scene, semantics):
    """A source whose labels are nonsense leaves nothing to align."""
    scene = labelled_room
    renderer = ViewRenderer(semantics=semantics)
    start = scene.T_target_source
    gated = FineRegistration(RegistrationOptions(views=1), renderer)
    right = gated.register(scene.target, scene.source, start)
    assert right.converged
    assert right.class_agreement > 0.8
    nonsense = scene.source.gaussians.features.roll(7, dims=1)
    clouds = replace(scene.source.gaussians, features=nonsense)
    wrong = gated.register(scene.target, replace(scene.source, gaussians=clouds), start)
    assert wrong.class_agreement < 0.3
    assert np.trace(wrong.information) < 0.5 * np.trace(right.information)
