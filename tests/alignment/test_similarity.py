"""Similarity of two aligned views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tracked_room import Room, small_motion

from toolkit.base.geometry import se3
from toolkit.splatting.alignment.data import FrameLevel
from toolkit.splatting.alignment.levels import finest_level, model_level
from toolkit.splatting.alignment.similarity import Similarity, aligned_correlation

CPU = torch.device("cpu")


def levels(room: Room, first: int, second: int) -> tuple[FrameLevel, FrameLevel]:
    return tuple(finest_level(room.frames[k], CPU) for k in (first, second))


def motion(room: Room, first: int, second: int) -> np.ndarray:
    return se3.inverse(room.T_map_camera[first]) @ room.T_map_camera[second]


def compared(room: Room, first: int, second: int, error=None) -> Similarity:
    view, frame = levels(room, first, second)
    T = motion(room, first, second)
    return aligned_correlation(model_level(view), frame, T if error is None else T @ error)


def test_a_view_agrees_with_itself(room: Room):
    same = compared(room, 0, 0)
    assert same.correlation == pytest.approx(1.0, abs=1e-6)
    # Pixels whose neighbours have no depth are not part of the model.
    assert same.covered > 0.9 and same.agreeing == 1.0


def test_views_of_one_room_agree_at_their_true_poses(room: Room):
    true = compared(room, 0, 5)
    assert true.correlation > 0.95 and true.blocks > 30
    assert true.agreeing > 0.95


@pytest.mark.parametrize("degrees", [2.0, 4.0])
def test_a_wrong_rotation_lowers_the_correlation(room: Room, degrees: float):
    true = compared(room, 0, 5)
    wrong = compared(room, 0, 5, small_motion(1, 0.0, degrees))
    assert wrong.correlation < true.correlation - 0.2
    assert wrong.low_correlation <= wrong.correlation


def test_exposure_does_not_matter(room: Room):
    view, frame = levels(room, 0, 5)
    T = motion(room, 0, 5)
    model = model_level(view)
    darker = replace(frame, intensity=0.6 * frame.intensity + 0.1)
    assert aligned_correlation(model, darker, T).correlation == pytest.approx(
        aligned_correlation(model, frame, T).correlation, abs=3e-3
    )


def test_a_surface_in_measured_free_space_contradicts(room: Room):
    view, frame = levels(room, 0, 5)
    T, model = motion(room, 0, 5), model_level(view)
    nearer = replace(frame, depth_m=0.7 * frame.depth_m)
    farther = replace(frame, depth_m=1.5 * frame.depth_m)
    assert aligned_correlation(model, nearer, T).agreeing < 0.1
    assert aligned_correlation(model, farther, T).agreeing < 0.1


def test_a_view_to_the_other_side_is_not_covered(room: Room):
    turned = compared(room, 0, 5, se3.exp(np.array([0, 0, 0, 0, np.pi, 0])))
    assert turned.covered == 0.0 and np.isnan(turned.correlation)


def test_texture_that_only_one_view_shows_is_no_agreement(room: Room):
    view, frame = levels(room, 0, 0)
    noise = torch.from_numpy(np.random.default_rng(0).normal(0.5, 0.01, frame.intensity.shape))
    blank = replace(frame, intensity=noise.to(torch.float32))
    assert aligned_correlation(model_level(view), blank, np.eye(4)).correlation < 0.2


def test_a_frame_without_depth_is_no_evidence(room: Room):
    view, frame = levels(room, 0, 0)
    blind = replace(frame, depth_m=torch.zeros_like(frame.depth_m))
    found = aligned_correlation(model_level(view), blind, np.eye(4))
    assert found.blocks == 0 and found.covered == 0.0 and np.isnan(found.correlation)
