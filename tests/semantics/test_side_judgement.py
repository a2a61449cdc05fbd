"""The side of the images that is up, found in a few frames without poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_room import looking, see, walk

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.options import DatasetOptions
from toolkit.datasets.orientation import oriented, oriented_camera
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.samples import evenly_spaced
from toolkit.semantics.segmenters.geometric.image_side import SideJudgement, judge_side

SIDE_OF_ROLL = {0.0: "top", 90.0: "left", 180.0: "bottom", -90.0: "right"}


def rolled(roll_deg: float, height_m: float = 1.5, at_m: float = 0.9) -> list[Frame]:
    """A turn on the spot that looks at a height, seen by a camera that is rolled."""
    frames = []
    for index, angle in enumerate(np.linspace(0.0, 2 * np.pi, 10, endpoint=False)):
        eye = (-0.2 + 0.1 * np.cos(angle), -0.6, height_m)
        at = (eye[0] + 2 * np.sin(angle), eye[1] + 2 * np.cos(angle), at_m)
        frames.append(see(looking(eye, at, roll_deg), index=index).frame)
    return frames


@pytest.mark.parametrize(("roll_deg", "side"), SIDE_OF_ROLL.items())
def test_floor_and_walls_show_which_side_is_up(roll_deg, side):
    assert judge_side(rolled(roll_deg)) == SideJudgement(side)


@pytest.mark.parametrize("roll_deg", [-25.0, 70.0, 205.0])
def test_an_inclined_camera_has_the_nearest_side(roll_deg):
    nearest = min(SIDE_OF_ROLL, key=lambda r: abs((roll_deg - r + 180.0) % 360.0 - 180.0))
    assert judge_side(rolled(roll_deg)) == SideJudgement(SIDE_OF_ROLL[nearest])


def test_a_strong_pitch_changes_nothing():
    assert judge_side(rolled(90.0, at_m=-0.5)) == SideJudgement("left")
    assert judge_side(rolled(0.0, at_m=-0.5)) == SideJudgement("top")


def test_a_portrait_image_is_judged_like_others():
    tall = Camera(128.0, 128.0, 59.5, 79.5, 120, 160)
    frames = [view.frame for view in walk(10, 90.0, tall)]
    assert judge_side(frames) == SideJudgement("left")


def test_a_ceiling_may_be_a_floor_so_that_the_side_is_in_doubt():
    assert judge_side(rolled(0.0, height_m=1.2, at_m=2.3)) == SideJudgement("top", "bottom")


@pytest.mark.parametrize("at_m", [0.9, 1.5])
def test_a_camera_that_stands_still_is_taken_as_upright(at_m):
    frame = see(looking((-0.2, -0.6, 1.5), (2.0, 1.0, at_m))).frame
    assert judge_side([frame] * 10) == SideJudgement("top")


@pytest.mark.parametrize("aside_m", [-1.5, 0.5, 1.5])
def test_walls_and_ceiling_alone_are_no_evidence(aside_m):
    eyes = [(0.0, y, 1.4) for y in (-1.0, -0.9, -0.8, -0.7)]
    frames = [see(looking(eye, (2.0, eye[1] + aside_m, 1.4))).frame for eye in eyes]
    assert judge_side(frames) == SideJudgement("top")


def test_frames_without_depth_are_no_evidence():
    frame = rolled(90.0)[0]
    blank = Frame(0, 0.0, frame.rgb, np.zeros_like(frame.depth_m), frame.camera)
    assert judge_side([blank] * 8) == SideJudgement("top")
    assert judge_side([]) == SideJudgement("top")


RECORDINGS = [
    ("seven-scenes", "7scenes_redkitchen"),
    ("replica", "replica_office0"),
    ("folder", "hololens_walk"),
    ("tum", "tum_fr1_rpy"),
    ("folder", "corridor"),
]


def some_frames(kind: str, path: Path) -> list[Frame]:
    options = DatasetOptions(readout_ms=0.0, ignore_carrier=False)
    dataset = open_dataset(kind, path, options=options)
    return [dataset[i] for i in evenly_spaced(len(dataset), 16)]


def turned_frame(frame: Frame, orientation: int) -> Frame:
    rgb, depth_m = (oriented(image, orientation) for image in (frame.rgb, frame.depth_m))
    return Frame(frame.index, 0.0, rgb, depth_m, oriented_camera(frame.camera, orientation))


@pytest.mark.parametrize(("kind", "name"), RECORDINGS)
def test_real_recordings_are_upright_without_doubt(real_data, kind, name):
    assert judge_side(some_frames(kind, real_data(name))) == SideJudgement("top")


@pytest.mark.parametrize(("kind", "name"), RECORDINGS[:3])
def test_real_recordings_are_recognised_when_they_are_turned(real_data, kind, name):
    frames = some_frames(kind, real_data(name))
    # EXIF's orientations: a half turn, a quarter clockwise, and one counterclockwise.
    for orientation, side in ((3, "bottom"), (6, "right"), (8, "left")):
        turned = [turned_frame(frame, orientation) for frame in frames]
        assert judge_side(turned) == SideJudgement(side)
