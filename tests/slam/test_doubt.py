"""Doubtful frames: they extend no map, are in no result, and end a submap only if they last."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from slam_room import FEW, another_place, fed, first_steps

from toolkit.base.options import validated
from toolkit.slam.front_end import FrontEnd
from toolkit.slam.loops.closing.factory import ClosingContext, build_loop_closer
from toolkit.slam.loops.closing.options import LoopClosureOptions
from toolkit.slam.mapping.mapper import Mapper
from toolkit.slam.mapping.semantic_mapping import SemanticMapping
from toolkit.slam.system import Slam
from toolkit.slam.tracking.confirmation import shows_same_place
from toolkit.slam.tracking.dense import DenseTracker

pytestmark = pytest.mark.usefixtures("few_matches")


@pytest.fixture(scope="module")
def room():
    return first_steps(12)


def new_slam(**relocalisation):
    settings = validated(LoopClosureOptions, {"relocalisation": relocalisation})
    closer = build_loop_closer(settings, ClosingContext(0, "auto", SemanticMapping(), None))
    return Slam(FrontEnd(DenseTracker(), closer), Mapper(FEW, np.random.default_rng(0)))


def painted(frame):
    """The depth of a frame with another texture: its pose cannot be confirmed."""
    rgb = np.random.default_rng(frame.index).random(frame.rgb.shape, np.float32)
    return replace(frame, rgb=rgb)


def blank_wall(frame):
    """A wall without texture at 1 m, with noise."""
    rng = np.random.default_rng(frame.index)
    noise = 0.01 * rng.standard_normal((2, *frame.depth_m.shape)).astype(np.float32)
    return replace(frame, rgb=np.stack([0.6 + noise[0]] * 3, axis=-1), depth_m=1.0 + noise[1])


def test_a_frame_in_doubt_extends_no_map_and_is_in_no_result(room):
    slam = new_slam(patience=10)
    fed(slam, room.frames[:5])
    count, keyframes = len(slam.atlas.gaussians), len(slam.atlas.keyframes)
    result = slam.process_frame(painted(room.frames[5]))
    assert (result.doubtful or result.lost) and result.reason and result.mapping is None
    assert len(slam.atlas.gaussians) == count and len(slam.atlas.keyframes) == keyframes
    assert not slam.process_frame(room.frames[6]).reason
    final = slam.result()
    assert 5 not in final.frame_indices and 6 in final.frame_indices
    assert 5 in {**final.doubtful_frames, **final.lost_frames}


@pytest.mark.parametrize(("period_s", "started"), [(1 / 30, False), (0.5, True)])
def test_patience_ends_by_time_at_a_low_frame_rate(room, period_s, started):
    """Four frames elsewhere, within an eighth of a second or within two seconds."""
    slam = new_slam(patience=15)
    shown = [*room.frames[:4], *map(another_place, room.frames[4:8])]
    fed(slam, [replace(f, index=k, timestamp_s=period_s * k) for k, f in enumerate(shown)])
    assert (len(slam.atlas) == 2) == started


def test_a_blank_wall_becomes_no_map(room):
    slam = new_slam(patience=2)
    shown = [*room.frames[:4], *map(blank_wall, room.frames[4:10]), *room.frames[3:1:-1]]
    results = fed(slam, [replace(f, index=k, timestamp_s=k / 30) for k, f in enumerate(shown)])
    assert all(result.lost or result.doubtful for result in results[4:10])
    assert not any(result.lost or result.doubtful for result in results[10:])
    assert len(slam.atlas) == 1


def test_two_frames_confirm_each_other_only_if_they_show_one_place(room):
    first, second, far = room.frames[0], room.frames[1], another_place(room.frames[8])
    assert shows_same_place(first, second)
    assert not shows_same_place(first, far)
    assert not shows_same_place(blank_wall(first), blank_wall(second))
