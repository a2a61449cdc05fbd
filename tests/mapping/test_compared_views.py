"""The final refinement compares the frames between keyframes as well."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from toolkit.base.exposure import Exposure
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.compared_views import ComparedViews
from toolkit.slam.submaps.intermediate_views import IntermediateView

_CAMERA = Camera(40.0, 40.0, 23.5, 15.5, 48, 32)
_T_KEYFRAME_CAMERA = se3.exp([0.1, 0.0, 0.2, 0.0, 0.1, 0.0])


def frame(index: int) -> Frame:
    """A smooth image, with a hole in its depth."""
    x, y = np.meshgrid(np.linspace(0, 1, 48), np.linspace(0, 1, 32))
    rgb = np.stack([x, y, 0.5 * (x + y)], axis=-1).astype(np.float32)
    depth_m = (1.0 + 2.0 * y).astype(np.float32)
    depth_m[:4, :4] = 0.0
    return Frame(index, index / 30.0, rgb, depth_m, _CAMERA)


def keyframe(index: int) -> Keyframe:
    return Keyframe.from_frame(frame(index), se3.exp([0.0, 0.0, 0.01 * index, 0.0, 0.0, 0.0]))


def view(index: int, after: int) -> IntermediateView:
    return IntermediateView.of(frame(index), after, _T_KEYFRAME_CAMERA, Exposure(1.5, 0.1))


def drawn(views: ComparedViews, count: int) -> Counter[int]:
    return Counter(views.next().index for _ in range(count))


def test_an_opened_view_is_its_frame_at_the_pose_that_its_keyframe_has_now() -> None:
    seen, balance = frame(7), (1.1, 1.0, 0.9)
    moved = se3.exp([0.3, -0.1, 0.2, 0.1, 0.2, 0.0])
    before = replace(keyframe(5), T_map_camera=moved, exposure=Exposure(balance=balance))
    opened = view(7, 5).opened(before)
    np.testing.assert_allclose(opened.T_map_camera, moved @ _T_KEYFRAME_CAMERA)
    assert opened.exposure == Exposure(1.5, 0.1, balance=balance)
    np.testing.assert_allclose(opened.rgb.permute(1, 2, 0) / 255.0, seen.rgb, atol=0.02)
    np.testing.assert_allclose(opened.depth_m, seen.depth_m, rtol=1e-3)
    assert torch.equal(opened.depth_m == 0, torch.from_numpy(seen.depth_m == 0))


def test_inferred_depth_is_left_out() -> None:
    inferred = np.zeros((32, 48), bool)
    inferred[10:20] = True
    found = IntermediateView.of(
        replace(frame(7), inferred=inferred), 5, _T_KEYFRAME_CAMERA, Exposure()
    )
    np.testing.assert_array_equal(found.depth_m == 0, inferred | (frame(7).depth_m == 0))


def test_all_are_compared_equally_often() -> None:
    views = ComparedViews(
        [keyframe(0), keyframe(5)], [view(n, 0) for n in (1, 2, 3)], np.random.default_rng(0)
    )
    assert drawn(views, 15) == dict.fromkeys((0, 5, 1, 2, 3), 3)


@pytest.mark.parametrize("hidden_in", [0, 5])
def test_views_beside_moving_objects_are_left_out(hidden_in: int) -> None:
    keyframes = [keyframe(0), keyframe(5), keyframe(10)]
    next(k for k in keyframes if k.index == hidden_in).hide(torch.ones(32, 48, dtype=torch.bool))
    views = [view(2, 0), view(11, 10), view(21, 20)]
    compared = ComparedViews(keyframes, views, np.random.default_rng(0))
    assert set(drawn(compared, 12)) == {0, 5, 10, 11}, "20 is no keyframe"


def test_what_is_ignored_hides_the_scene_in_keyframes_and_views() -> None:
    ignored = np.zeros((32, 48), bool)
    ignored[10:20, 5:17] = True
    keyframes = [Keyframe.from_frame(replace(frame(n), ignored=ignored), np.eye(4)) for n in (0, 5)]
    between = IntermediateView.of(
        replace(frame(2), ignored=ignored), 0, _T_KEYFRAME_CAMERA, Exposure()
    )
    saved = IntermediateView.from_state(between.arrays(), between.values())
    compared = ComparedViews(keyframes, [saved], np.random.default_rng(0))
    assert set(drawn(compared, 6)) == {0, 2, 5}
    for shown in (*keyframes, saved.opened(keyframes[0])):
        np.testing.assert_array_equal(shown.transient, ignored)
    moving = torch.zeros(32, 48, dtype=torch.bool)
    moving[0, 0] = True
    keyframes[0].hide(moving)
    np.testing.assert_array_equal(keyframes[0].transient, ignored | moving.numpy())


def test_a_view_that_contradicts_the_map_is_not_compared_again() -> None:
    views = ComparedViews([keyframe(0)], [view(1, 0), view(2, 0)], np.random.default_rng(0))
    for index, loss in ((0, 0.1), (1, 0.15), (2, 0.9)):
        views.compared(replace(keyframe(0), index=index), loss)
    assert drawn(views, 8) == {0: 4, 1: 4}
