"""Number of optimisation steps on a new keyframe: as many as its residual needs."""

from __future__ import annotations

import numpy as np
import pytest
from mapped_submap import MappedSubmap

from tests.painted_box import box_frames, path
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping import mapper as mapper_module
from toolkit.slam.mapping.effort import Effort
from toolkit.slam.mapping.options import MapperOptions


def steps_taken(losses: list[float], minimum: int = 3, maximum: int = 12) -> int:
    """Steps on a keyframe with these losses, of which those of other keyframes are ignored."""
    effort, left = Effort(minimum, maximum), iter(losses)
    while effort.wanted:
        effort.took(next(left) if effort.measures else None)
    return effort.taken


@pytest.mark.parametrize(
    ("losses", "expected"),
    [
        ([0.1, 0.099], 3),  # does not fall
        ([0.1, 0.005], 3),  # explained
        ([0.1, 0.05, 0.049], 5),  # fell, then did not
        ([0.1 * 0.8**k for k in range(12)], 12),  # falls to the end
    ],
)
def test_steps_end_when_the_loss_is_explained_or_stops_falling(losses, expected):
    assert steps_taken(losses) == expected


def test_minimum_and_maximum_hold():
    falling = [0.5**k for k in range(20)]
    assert steps_taken(falling, minimum=3, maximum=3) == 3
    assert steps_taken([], minimum=0, maximum=12) == 0
    assert steps_taken([1.0], minimum=1, maximum=12) == 1


def test_a_keyframe_reports_its_steps(monkeypatch):
    monkeypatch.setattr(mapper_module, "_MAX_ITERATIONS", 5)
    options = MapperOptions(first_iterations=2, iterations=3)
    mapper = MappedSubmap(options, np.random.default_rng(0))
    poses = path(2)
    first, second = (
        mapper.add_keyframe(Keyframe.from_frame(frame, T))
        for frame, T in zip(box_frames(poses, 40, 30), poses, strict=True)
    )
    assert first.steps == 2 and 3 <= second.steps <= 5
