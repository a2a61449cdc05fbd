"""A panel that moves through a painted box, in front of a well-observed map."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap

from tests.painted_box import box_frames, path
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.moving_objects import _held_s
from toolkit.slam.mapping.optimisation import Objective
from toolkit.slam.mapping.options import MapperOptions

WIDTH, HEIGHT = 80, 60
PANEL_M = 1.1
T_MAP_CAMERA = path(14)
EMPTY = box_frames(T_MAP_CAMERA, WIDTH, HEIGHT)


def with_panel(frame: Frame, left: int, colour: float | None = 0.95) -> Frame:
    """The frame with an upright panel at columns `left` to `left + 16`, 1.1 m away."""
    rgb, depth_m = frame.rgb.copy(), frame.depth_m.copy()
    region = np.s_[12:52, left : left + 16]
    depth_m[region] = PANEL_M
    if colour is not None:
        rgb[region] = (colour, 0.05, 0.05)
    return replace(frame, rgb=rgb, depth_m=depth_m)


def walked() -> list[Frame]:
    """The panel enters after eight frames and moves to the right."""
    return [f if i < 8 else with_panel(f, 8 * (i - 8) + 4) for i, f in enumerate(EMPTY)]


def mapped(
    frames: Iterable[Frame], use: bool = True, poses: np.ndarray = T_MAP_CAMERA
) -> MappedSubmap:
    mapper = MappedSubmap(MapperOptions(moving_objects=use, first_iterations=5))
    for frame, pose in zip(frames, poses, strict=False):
        mapper.add_keyframe(Keyframe.from_frame(frame, pose))
    return mapper


def on_panel(mapper: MappedSubmap, T_map_camera: np.ndarray) -> int:
    """Number of Gaussians at the distance of the panel, in the middle of the view."""
    T = torch.from_numpy(se3.inverse(T_map_camera).astype(np.float32))
    points = mapper.gaussians.means @ T[:3, :3].T + T[:3, 3]
    x, y, z = points.unbind(dim=1)
    return int((((z - PANEL_M).abs() < 0.04) & (x.abs() < 0.6 * z) & (y.abs() < 0.4)).sum())


def test_a_moving_panel_is_hidden_and_not_mapped():
    mapper = mapped(walked())
    for keyframe, frame in zip(mapper.keyframes, walked(), strict=True):
        panel = np.abs(frame.depth_m - EMPTY[keyframe.index].depth_m) > 0.05
        if keyframe.index < 8:
            assert keyframe.transient is None
            continue
        mask = keyframe.transient.numpy()
        assert mask[panel].mean() > 0.95
        assert mask.mean() < 1.7 * panel.mean()
        assert (keyframe.depth_m.numpy()[mask] == 0).all()
        np.testing.assert_array_equal(keyframe.observed_m.numpy(), frame.depth_m)
    assert on_panel(mapper, T_MAP_CAMERA[-1]) == 0
    assert on_panel(mapped(walked(), use=False), T_MAP_CAMERA[-1]) > 200


def test_hidden_colour_has_no_influence_on_the_map():
    mapper = mapped(walked())
    arrays, values = mapper.state()
    saved = {name: array.copy() for name, array in arrays.items()}, values
    colours = []
    for repaint in (False, True):
        mapper.restore(*saved)
        keyframe = mapper.keyframes[-1]
        assert keyframe.transient is not None
        if repaint:
            keyframe.rgb = keyframe.rgb.masked_fill(keyframe.transient, 0)
        before = mapper.gaussians.colours.clone()
        mapper.step(keyframe, (0, 1), Objective())
        colours.append(mapper.gaussians.colours.clone())
    assert not torch.equal(colours[0], before)
    assert torch.equal(*colours)


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param(lambda: EMPTY, id="nothing moves"),
        pytest.param(
            lambda: [f if i < 8 else with_panel(f, 30, colour=None) for i, f in enumerate(EMPTY)],
            id="colour agrees with the map",
        ),
        pytest.param(lambda: [*EMPTY[:1], *map(with_panel, EMPTY[8:], 6 * [30])], id="seen once"),
    ],
)
def test_nothing_is_hidden_without_contradiction(frames: Callable[[], list[Frame]]):
    mapper = mapped(frames())
    assert all(keyframe.transient is None for keyframe in mapper.keyframes)


def test_an_object_that_was_there_from_the_start_is_not_hidden():
    frames = [replace(with_panel(EMPTY[0], 30), index=i) for i in range(12)]
    mapper = mapped(frames, poses=np.repeat(np.eye(4)[None], 12, axis=0))
    assert all(keyframe.transient is None for keyframe in mapper.keyframes)
    assert on_panel(mapper, np.eye(4)) > 300


@pytest.mark.parametrize("error_m", [(0.0, 0.0, 0.25), (0.1, 0.0, 0.0), (-0.05, 0.1, 0.0)])
def test_a_wrong_pose_hides_nothing(error_m: tuple[float, float, float]):
    poses = T_MAP_CAMERA.copy()
    poses[10:, :3, 3] += error_m
    assert all(k.transient is None for k in mapped(EMPTY, poses=poses).keyframes)


@pytest.mark.parametrize("known", [False, True])
def test_an_object_that_was_just_hidden_needs_less_evidence(known: bool):
    mapper = mapped([EMPTY[0], with_panel(EMPTY[1], 20)])
    last = mapper.keyframes[-1]
    assert last.transient is None  # one keyframe does not suffice
    if known:
        last.hide(last.depth_m == PANEL_M)
    frame = with_panel(EMPTY[2], 30)
    mapper.add_keyframe(Keyframe.from_frame(frame, T_MAP_CAMERA[2]))
    assert (mapper.keyframes[-1].transient is not None) == known


def test_an_object_that_stays_is_mapped():
    frames = [*EMPTY[:8], *(with_panel(frame, 30) for frame in EMPTY[8:])]
    frames = [replace(frame, timestamp_s=float(frame.index)) for frame in frames]
    mapper = mapped(frames)
    hidden = [k.index for k in mapper.keyframes if k.transient is not None]
    assert hidden == [8, 9, 10]
    assert on_panel(mapper, T_MAP_CAMERA[-1]) > 200


def test_checkpoints_keep_what_is_hidden():
    keyframe = mapped(walked()).keyframes[-1]
    again = Keyframe.from_state(keyframe.arrays(), keyframe.values())
    assert torch.equal(again.transient, keyframe.transient)
    assert torch.equal(again.observed_m, keyframe.observed_m)
    assert torch.equal(again.images.transient, keyframe.transient)


@pytest.mark.parametrize(
    ("depths_m", "longest_s", "expected_s"),
    [
        ((2.0, 2.0, 2.0), 9.0, 3.0),
        ((2.0, 3.0, 2.0), 9.0, 1.0),  # the place was empty two seconds ago
        ((2.0, 1.0, 2.0), 9.0, 3.0),  # the place was covered
        ((2.0, 2.0, 2.0), 2.5, 2.0),
    ],
)
def test_surfaces_are_held_since_they_were_last_empty(depths_m, longest_s, expected_s):
    camera = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)
    rgb = np.zeros((30, 40, 3), np.float32)
    frames = [
        Frame(n, float(n), rgb, np.full((30, 40), z, np.float32), camera)
        for n, z in enumerate((*depths_m, 2.0))
    ]
    *others, newest = [Keyframe.from_frame(frame, np.eye(4)) for frame in frames]
    # Before and behind the measured surface, within the margin of measurements.
    means = torch.tensor([[0.0, 0.0, 1.98], [0.1, 0.1, 2.02]])
    assert _held_s(means, newest, others, longest_s).tolist() == [expected_s] * 2
