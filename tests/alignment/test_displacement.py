"""Displacement of two aligned views that no pose explains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from tracked_room import Room

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.slam.tracking.rolling_shutter import as_exposed
from toolkit.splatting.alignment import displacement
from toolkit.splatting.alignment.displacement import displacement_rad
from toolkit.splatting.alignment.levels import finest_level, model_level
from toolkit.splatting.alignment.similarity import COLUMNS, ROWS

CPU = torch.device("cpu")


def measured(room: Room, second: Frame, error=None) -> float:
    model = model_level(finest_level(room.frames[0], CPU))
    T = se3.inverse(room.T_map_camera[0]) @ room.T_map_camera[5]
    T = T if error is None else T @ se3.exp(np.array(error))
    return displacement_rad(model, finest_level(second, CPU), T)


def bent(frame: Frame, turn_rad_s) -> Frame:
    rolling = replace(frame, readout_s=0.03)
    rgb, depth_m = as_exposed(frame.rgb, frame.depth_m, rolling, np.array([0, 0, 0, *turn_rad_s]))
    return replace(frame, rgb=rgb, depth_m=depth_m)


def test_nothing_is_displaced_at_the_true_pose(room: Room):
    assert measured(room, room.frames[5]) < 0.001


@pytest.mark.parametrize("degrees", [0.5, 1.0])
def test_a_wrong_rotation_is_measured(room: Room, degrees: float):
    found = measured(room, room.frames[5], (0, 0, 0, 0, np.radians(degrees), 0))
    assert found == pytest.approx(np.radians(degrees), rel=0.25)


def test_exposure_does_not_matter(room: Room):
    darker = replace(room.frames[5], rgb=0.6 * room.frames[5].rgb + np.float32(0.1))
    assert measured(room, darker) < 0.001


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_bent_image_is_displaced_at_its_middle_row(room: Room, axis: int):
    turn = [0.0, 0.0, 0.0]
    turn[axis] = 4.0
    assert measured(room, bent(room.frames[5], turn)) > 5 * measured(room, room.frames[5])


def test_without_texture_nothing_is_known(room: Room):
    blank = replace(room.frames[5], rgb=np.full_like(room.frames[5].rgb, 0.5))
    assert np.isnan(measured(room, blank))
    blind = replace(room.frames[5], depth_m=np.zeros_like(room.frames[5].depth_m))
    assert np.isnan(measured(room, blind))


def test_blocks_are_numbered_row_by_row():
    rows, columns = np.indices((3 * ROWS, 2 * COLUMNS))
    found = displacement._block_numbers(rows.ravel(), columns.ravel(), rows.shape)
    numbers = np.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS)
    assert np.array_equal(found.reshape(rows.shape), np.kron(numbers, np.ones((3, 2), int)))
