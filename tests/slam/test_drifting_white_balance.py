"""A room whose images change their white balance: the map has that of the first image."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.slam.slam_room import FEW, first_steps
from toolkit.base.exposure import NEUTRAL
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.runs.evaluation.images import psnr_db
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.mapping.boundary import start_at, start_next
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.result import SlamResult
from toolkit.slam.system import Slam
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.splatting.rendering import render

FRAMES = first_steps(20).frames


def drifting(frame: Frame) -> Frame:
    gains = np.exp(0.015 * frame.index * np.array([1.0, 0.0, -1.0]))
    return replace(frame, rgb=(frame.rgb * gains).clip(0.0, 1.0).astype(np.float32))


def mapped(seen: Callable[[Frame], Frame] = drifting, use: bool = True) -> SlamResult:
    options = replace(FEW, white_balance=use)
    slam = Slam(FrontEnd(DenseTracker()), Mapper(options, np.random.default_rng(0)))
    for frame in FRAMES:
        slam.process_frame(seen(frame))
    return slam.finish()


def clean_psnr_db(result: SlamResult) -> float:
    """Mean PSNR of the map, at the exposure of the first image, against images without drift."""
    first, scores = result.exposures[0], []
    for frame, T_world_camera in zip(FRAMES, result.trajectory.T_world_camera, strict=True):
        view = render(result.gaussians, frame.camera, se3.inverse(T_world_camera))
        scores.append(psnr_db(first.undo(view.colour), frame.rgb))
    return float(np.mean(scores))


@pytest.fixture(scope="module")
def result() -> SlamResult:
    return mapped()


def test_the_map_has_one_white_balance(result):
    clean = clean_psnr_db(result)
    assert clean > clean_psnr_db(mapped(lambda frame: frame)) - 2.0
    assert clean > clean_psnr_db(mapped(use=False)) + 3.0


def test_the_exposure_of_each_frame_contains_its_white_balance(result):
    # Frames after the last keyframe have the white balance of that keyframe.
    count = result.keyframe_indices[-1] + 1
    first = result.exposures[0].inverse()
    for frame, exposure in zip(FRAMES[:count], result.exposures[:count], strict=True):
        red, _, blue = first.after(exposure).balance
        assert np.log(blue / red) == pytest.approx(0.03 * frame.index, abs=0.02)


def test_the_map_has_the_median_white_balance_of_its_keyframes(result):
    balances = [result.exposures[index].balance for index in result.keyframe_indices]
    np.testing.assert_allclose(np.median(balances, axis=0), 1.0, rtol=1e-6)


def test_constant_white_balance_changes_nothing():
    estimated, off = mapped(lambda frame: frame), mapped(lambda frame: frame, use=False)
    assert np.array_equal(estimated.gaussians.colours, off.gaussians.colours)
    assert estimated.exposures == off.exposures
    assert all(exposure.balance == NEUTRAL for exposure in estimated.exposures)


def test_submaps_share_the_reference_of_the_first():
    slam = Slam(FrontEnd(DenseTracker()), Mapper(FEW, np.random.default_rng(0)))
    for frame in FRAMES:
        slam.process_frame(drifting(frame))
    atlas, last = slam.atlas, slam.atlas.keyframes[-1]
    frame, T_submap_camera = drifting(FRAMES[last.index]), last.T_map_camera
    balance = last.exposure.balance
    # A submap that starts at the last keyframe, and one where the camera is relocalised.
    start_next(atlas, slam.mapper)
    assert slam.atlas.keyframes[0].exposure.balance == balance
    anchor = Keyframe.from_frame(frame, np.eye(4), last.exposure.with_balance(NEUTRAL))
    start_at(atlas, slam.mapper, anchor, (0, T_submap_camera))
    np.testing.assert_allclose(slam.atlas.keyframes[0].exposure.balance, balance, rtol=0.01)
    assert atlas.keyframe_balances(0)[last.index] == balance
