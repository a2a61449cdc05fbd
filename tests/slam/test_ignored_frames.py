"""Frames that are compared with a map lack what the run ignored."""

import numpy as np
import pytest
from slam_room import SlamRoom, first_steps

from toolkit.base.options import validated
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS, CLASS_NAMES
from toolkit.semantics.options import SegmenterOptions, SemanticsOptions
from toolkit.semantics.taxonomy_building.factory import build_labeller
from toolkit.slam.frame_preparation import FrameSources
from toolkit.slam.ignored_frames import FramesWithoutIgnored

NAMES = dict(enumerate(CLASS_NAMES, start=1))


class Recorded:
    """The frames of a room as a dataset."""

    def __init__(self, room: SlamRoom):
        self.name, self.ground_truth, self.label_names = "room", room.truth, NAMES
        self.camera, self.frames = room.frames[0].camera, room.frames

    def __len__(self):
        return len(self.frames)

    def __getitem__(self, index):
        return self.frames[index]

    def __iter__(self):
        return iter(self.frames)


class UpperRows:
    """Ignores the upper half as well, as masks of the run's own frames do."""

    def pixels(self, frame, ignored):
        return ignored | (np.arange(len(ignored)) < len(ignored) // 2)[:, None]


@pytest.fixture(scope="module")
def dataset():
    return Recorded(first_steps(2))


def sources(kind="recorded"):
    options = validated(SemanticsOptions, {"ignore": ["wall"]})
    labeller = build_labeller(options, validated(SegmenterOptions, {"kind": kind}), NAMES)
    labeller.others = UpperRows()
    return FrameSources(labeller)


def test_pixels_of_ignored_classes_and_masks_are_left_out(dataset):
    frame = FramesWithoutIgnored(dataset, sources())[1]
    wall = dataset[1].labels == CLASS_IDS["wall"]
    assert wall[40:].any() and (frame.ignored == UpperRows().pixels(frame, wall)).all()
    assert not frame.depth_m[frame.ignored].any() and not frame.labels[frame.ignored].any()
    assert (frame.labels == dataset[1].labels)[~frame.ignored].all()


def test_views_beside_the_sequence_have_labels_but_no_masks(dataset):
    frames = FramesWithoutIgnored(dataset, sources())
    view = frames.beside(dataset)[1]
    assert (view.ignored == (dataset[1].labels == CLASS_IDS["wall"])).all()


def test_without_labels_masks_alone_are_left_out(dataset):
    frame = FramesWithoutIgnored(dataset, FrameSources(None, ignored=UpperRows()))[0]
    assert frame.ignored[:36].all() and not frame.ignored[36:].any()
