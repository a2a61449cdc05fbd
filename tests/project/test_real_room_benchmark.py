"""How `benchmarks.real_room` scores views and masks."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import real_room
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe

CAMERA = Camera(256.0, 256.0, 159.5, 119.5, 320, 240)


def test_gain_and_bias_are_fitted_outside_of_the_walker():
    truth = np.random.default_rng(0).uniform(0.2, 0.8, (24, 32, 3)).astype(np.float32)
    outside = np.ones((24, 32), bool)
    outside[:, :10] = False
    rendered = (truth - 0.05) / 1.2
    rendered[~outside] = 1.0
    fitted = real_room.affinely_fitted(rendered, truth, outside)
    np.testing.assert_allclose(fitted[outside], truth[outside], atol=1e-6)


@pytest.mark.parametrize(("left", "found", "wrong"), [(100, 100, 0), (140, 50, 0), (300, 0, 20)])
def test_hidden_pixels_are_compared_with_the_walker(left: int, found: float, wrong: float):
    images = np.zeros((240, 320, 3), np.float32), np.ones((240, 320), np.float32)
    keyframe = Keyframe.from_frame(Frame(0, 0.0, *images, CAMERA), np.eye(4))
    mask, walker = np.zeros((2, 240, 320), bool)
    walker[:, 100:180] = True
    mask[:, left : min(left + 80, 180) if left < 200 else 320] = True
    keyframe.hide(torch.from_numpy(mask))
    scores = real_room.hidden([keyframe], lambda _: walker)
    assert scores["walker hidden percent"] == pytest.approx(found)
    # The margin beside the walker counts as neither.
    assert scores["wrongly hidden percent"] == pytest.approx(100 * wrong / 224, abs=0.1)


def test_a_missing_mask_is_reported(tmp_path):
    with pytest.raises(SystemExit, match="is missing"):
        real_room.walker_masks(tmp_path)(3)
