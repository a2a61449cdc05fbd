"""Frames get labels of one taxonomy, and lose what is to be ignored."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.base.errors import FormatError
from toolkit.base.frame import Frame, without_pixels
from toolkit.base.geometry.camera import Camera
from toolkit.semantics.labeller import Labeller

CAMERA = Camera(4.0, 4.0, 1.5, 0.5, 4, 2)


class Fixed:
    """Calls every pixel of a frame the same few names."""

    def __init__(self, ids, names=None) -> None:
        self.ids = np.array(ids, np.int32)
        self.class_names = names or {3: "Cup", 5: "bed"}

    def segment(self, frame, T_map_camera=None):
        return self.ids

    def state(self):
        return {}

    def restore(self, arrays) -> None:
        pass


def frame() -> Frame:
    rgb = np.zeros((2, 4, 3), np.float32)
    return Frame(7, 0.0, rgb, np.full((2, 4), 2.0, np.float32), CAMERA)


def test_ids_are_those_of_the_tree(tree):
    labelled = Labeller(Fixed([[3, 5, 0, 3]] * 2), tree).label(frame())
    cup, bed = tree.classes.index("cup") + 1, tree.classes.index("bed") + 1
    assert labelled.labels.tolist() == [[cup, bed, 0, cup]] * 2
    assert (labelled.depth_m == 2.0).all()


def test_what_is_ignored_has_neither_label_nor_depth(tree):
    bed = tree.classes.index("bed") + 1
    labeller = Labeller(Fixed([[3, 5, 0, 3]] * 2), tree, ignored=tree.find("small").class_ids)
    assert labeller.every_frame
    labelled = labeller.label(frame())
    assert labelled.labels.tolist() == [[0, bed, 0, 0]] * 2
    assert labelled.depth_m.tolist() == [[0.0, 2.0, 2.0, 0.0]] * 2
    assert labelled.ignored.tolist() == [[True, False, False, True]] * 2


@pytest.mark.parametrize("others", [[], ["small"]])
def test_what_a_frame_ignores_stays_ignored_and_gets_no_label(tree, others):
    last = np.array([[False, False, False, True]] * 2)
    ignored = [class_id for name in others for class_id in tree.find(name).class_ids]
    labeller = Labeller(Fixed([[3, 5, 0, 5]] * 2), tree, ignored=ignored)
    labelled = labeller.label(without_pixels(frame(), last))
    assert (labelled.labels[:, 1:] > 0).tolist() == [[True, False, False]] * 2
    assert labelled.ignored.tolist() == [[bool(others), False, False, True]] * 2


@pytest.mark.parametrize("wrong", [4, 77, -1])
def test_an_id_without_a_name_is_an_error(tree, wrong):
    labeller = Labeller(Fixed([[3, wrong, 0, 3]] * 2), tree, source="my labels")
    with pytest.raises(FormatError, match=f"my labels: frame 7 has class id {wrong}"):
        labeller.label(frame())


def test_a_tree_without_the_classes_is_refused(tree):
    with pytest.raises(FormatError, match="no class person"):
        Labeller(Fixed([[3]], {1: "person"}), tree)
