"""The side of images that is up."""

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.image_sides import (
    SIDES,
    mean_up,
    nearest_side,
    turned_upright,
    up_in_camera,
)


@pytest.mark.parametrize("side", SIDES)
def test_the_turned_camera_has_its_top_up(side):
    R = turned_upright(side)
    assert pytest.approx(np.eye(3)) == R @ R.T
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert R.T @ up_in_camera(side) == pytest.approx([0.0, -1.0, 0.0])
    assert nearest_side(up_in_camera(side)[None]) == side


def test_sides_are_those_of_the_image():
    # x is right, y down and z forward.
    assert up_in_camera("right") == pytest.approx([1.0, 0.0, 0.0])
    assert up_in_camera("bottom") == pytest.approx([0.0, 1.0, 0.0])
    assert up_in_camera("backward") == pytest.approx([0.0, 0.0, -1.0])


def test_a_tilted_camera_has_the_same_side():
    # 70 degrees down is not straight down.
    up = np.array([[-np.cos(np.radians(70.0)), 0.05, -np.sin(np.radians(70.0))]])
    assert nearest_side(up) == "left"
    assert nearest_side(np.array([[-0.1, 0.1, -0.99]])) == "backward"


def test_the_mean_of_turning_cameras_is_their_vertical():
    turns = [se3.exp_so3(np.array([0.0, angle, 0.0])) for angle in np.linspace(0, 6, 12)]
    upright = np.array([se3.from_rotation_translation(R, np.zeros(3)) for R in turns])
    turned = upright.copy()
    # The camera is turned so that its right side is up.
    turned[:, :3, :3] = upright[:, :3, :3] @ turned_upright("right").T
    assert mean_up(turned, "right") == pytest.approx([0.0, -1.0, 0.0])
    assert np.linalg.norm(mean_up(turned, "top")) < 0.5
