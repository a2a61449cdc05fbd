"""Depth priors compared with the points of a motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from moving_camera import film, walk
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.trajectory import Trajectory
from toolkit.depth.depth_priors.kind_check import MAX_KEYFRAMES
from toolkit.depth.depth_priors.options import DepthPriorOptions
from toolkit.depth.depth_priors.provider import (
    DepthKind,
    DepthPrior,
    PriorModel,
    PriorSet,
    ScaleScope,
)
from toolkit.depth.monocular.given import motion_of_given_poses
from toolkit.depth.monocular.motion import CameraMotion
from toolkit.depth.monocular.prior_check import doubt_about_priors

FRAMES = 12
OPTIONS = DepthPriorOptions(size=5)


class Maps:
    """Priors that follow from the true depth.

    Attributes:
        asked: numbers of the frames of each call.
    """

    model = PriorModel("maps")

    def __init__(
        self,
        values: Callable[[NDArray[np.float32]], NDArray[np.float32]],
        kind: DepthKind,
        joint: bool = False,
    ) -> None:
        self._values, self._kind, self.joint = values, kind, joint
        self.asked: list[list[int]] = []

    def predict(self, frames: Sequence[Frame]) -> PriorSet:
        indices = tuple(frame.index for frame in frames)
        self.asked.append(list(indices))
        priors = tuple(
            DepthPrior(self._values(frame.depth_m), self._kind, ScaleScope.FRAME, self.model)
            for frame in frames
        )
        return PriorSet(indices, priors)


@pytest.fixture(scope="module")
def views() -> list[Frame]:
    return film(walk(FRAMES))


@pytest.fixture(scope="module")
def motion(views) -> CameraMotion:
    given = Trajectory(np.arange(FRAMES) / 30.0, walk(FRAMES))
    return motion_of_given_poses(views, views[0].camera, given, metric=True)


def test_the_points_of_keyframes_have_the_depth_of_their_pixels(views, motion):
    for view in motion.views:
        column, row = np.rint(view.points[:, :2]).astype(int).T
        errors = np.abs(view.points[:, 2] / views[view.frame].depth_m[row, column] - 1.0)
        assert len(view.points) > 50
        assert np.median(errors) < 0.02


def test_points_follow_the_unit_of_length(motion):
    view = motion.views[3]
    grown = view.scaled(view.T_world_camera, 2.0)
    np.testing.assert_allclose(grown.points[:, 2], 2.0 * view.points[:, 2])
    np.testing.assert_array_equal(grown.points[:, :2], view.points[:, :2])
    assert grown.near == 2.0 * view.near


@pytest.mark.parametrize("kind", [DepthKind.METRIC, DepthKind.AFFINE])
def test_right_priors_raise_no_doubt(views, motion, kind):
    maps = Maps(lambda depth_m: depth_m, kind)
    assert doubt_about_priors(motion, views, maps, OPTIONS, "--values") is None
    (asked,) = maps.asked
    assert len(asked) == MAX_KEYFRAMES
    assert asked[0] == motion.views[0].frame and asked[-1] == motion.views[-1].frame


def test_inverse_depth_that_is_declared_as_metric_is_named(views, motion):
    maps = Maps(lambda depth_m: 1.0 / np.maximum(depth_m, 0.1), DepthKind.METRIC)
    doubt = doubt_about_priors(motion, views, maps, OPTIONS, "--values")
    assert doubt is not None and "use --values affine-inverse" in doubt


def test_a_model_of_several_images_is_given_neighbouring_keyframes(views, motion):
    maps = Maps(lambda depth_m: depth_m, DepthKind.SCALED, joint=True)
    assert doubt_about_priors(motion, views, maps, OPTIONS, None) is None
    (asked,) = maps.asked
    numbers = [view.frame for view in motion.views]
    first = numbers.index(asked[0])
    assert asked == numbers[first : first + OPTIONS.size]
