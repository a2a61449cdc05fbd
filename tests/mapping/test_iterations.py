"""Number of optimisation steps on a new keyframe: more for small images."""

from __future__ import annotations

import numpy as np
import pytest

from tests.painted_box import box_frames, path
from toolkit.keyframe import Keyframe
from toolkit.mapping.deferred import DeferredSteps
from toolkit.mapping.mapper import Mapper
from toolkit.mapping.options import MapperOptions


@pytest.mark.parametrize(
    ("width", "height", "expected"), [(320, 240, 2), (200, 150, 5), (160, 120, 8), (40, 30, 8)]
)
def test_steps_on_a_second_keyframe(width, height, expected):
    options = MapperOptions(first_iterations=1, iterations=2)
    mapper = Mapper(options, np.random.default_rng(0))
    poses = path(2)
    first, second = (
        Keyframe.from_frame(frame, T)
        for frame, T in zip(box_frames(poses, width, height), poses, strict=True)
    )
    mapper.add_keyframe(first)
    mapper.deferred = DeferredSteps()
    mapper.add_keyframe(second)
    due = mapper.deferred.next()
    assert due is not None
    assert due.total == expected
