"""What moves with the camera is found while frames arrive, and removed from the map so far."""

import json
from dataclasses import replace

import numpy as np
import pytest
from slam_room import first_steps, new_slam

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.slam.carrier_watch import CarrierWatch
from toolkit.slam.frame_preparation import FrameSources

BODY = np.zeros((72, 96), bool)
BODY[58:] = True


def with_body(frame: Frame) -> Frame:
    rgb = np.where(BODY[..., None], np.float32([0.3, 0.3, 0.4]), frame.rgb)
    depth_m = np.where(BODY, np.float32(0.5), frame.depth_m)
    return replace(frame, rgb=rgb, depth_m=depth_m, timestamp_s=0.1 * frame.index)


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    return [with_body(frame) for frame in first_steps(10).frames]


def test_it_is_ignored_from_the_eighth_frame_on(frames):
    watch = CarrierWatch()
    shown = [watch.of(frame, None) for frame in frames]
    assert [frame.ignored is not None for frame in shown] == [False] * 7 + [True] * 3
    assert shown[-1].ignored[BODY].all()
    assert shown[-1].ignored.mean() < BODY.mean() + 0.06


def test_a_still_camera_is_watched_until_it_moves(frames):
    watch, waiting = CarrierWatch(), [replace(frames[0], timestamp_s=0.1 * n) for n in range(20)]
    assert all(watch.of(frame, None).ignored is None for frame in waiting)
    there_and_back = 2 * [*frames, *frames[::-1]]
    later = [replace(f, timestamp_s=2.0 + 0.2 * n) for n, f in enumerate(there_and_back)]
    ignoring = [watch.of(frame, None).ignored is not None for frame in later]
    assert not ignoring[0] and ignoring[-1]


def test_a_restored_watch_continues_identically(frames):
    watch, restored = CarrierWatch(), CarrierWatch()
    for frame in frames[:5]:
        watch.of(frame, None)
    arrays, values = watch.state()
    restored.restore(arrays, json.loads(json.dumps(values)))
    for frame in frames[5:]:
        expected, found = watch.of(frame, None), restored.of(frame, None)
        np.testing.assert_array_equal(found.depth_m, expected.depth_m)
    for name, array in watch.state()[0].items():
        np.testing.assert_array_equal(restored.state()[0][name], array)


def test_the_map_so_far_loses_it(frames):
    slam = new_slam(sources=FrameSources(watches_carrier=True))
    for frame in frames[:7]:
        slam.process_frame(frame)
    assert nearest_m(slam) < 0.55
    slam.process_frame(frames[7])
    assert nearest_m(slam) > 0.7
    assert all(not keyframe.depth_m.numpy()[BODY].any() for keyframe in slam.atlas.keyframes)
    assert "carrier" in slam.state()[1]


def nearest_m(slam) -> float:
    T_camera_map = se3.inverse(slam.atlas.keyframes[0].T_map_camera)
    points = se3.transform_points(T_camera_map, slam.atlas.gaussians.means.detach().numpy())
    return float(np.quantile(points[:, 2], 0.01))
