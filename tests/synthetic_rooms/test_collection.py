"""Rooms with hundreds of classes: shelves of small objects."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from programs import semsplat

from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms import collection
from toolkit.datasets.synthetic_rooms.furniture import Workshop
from toolkit.datasets.synthetic_rooms.layouts import single_room
from toolkit.datasets.synthetic_rooms.parts import bounds
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.semantics.taxonomy_building.vocabulary import SHAPES

CLASSES, FRAMES = 300, 8


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A room of 300 classes, as the program writes it."""
    path = tmp_path_factory.mktemp("rooms") / "collection"
    words = ["--classes", str(CLASSES), "--frames", str(FRAMES), "--image-size", "160", "120"]
    semsplat("make-room", "--out", path, *words, "--unseen", 0).check_returncode()
    return path


def test_nearly_every_class_is_visible_and_labels_have_16_bits(folder):
    dataset = open_dataset("synthetic", folder)
    assert list(dataset.label_names.values()) == list(collection.class_names(CLASSES))
    seen = np.unique(np.concatenate([dataset[i].labels.ravel() for i in range(FRAMES)]))
    assert seen.min() > 0
    assert seen.max() > 255
    # Eight coarse views around the room already show nearly all of them.
    assert len(seen) > 0.9 * CLASSES


def test_the_taxonomy_holds_the_classes_of_the_room(folder):
    tree = Taxonomy.load(folder / "taxonomy.yaml")
    assert tree.classes == collection.class_names(CLASSES)
    assert sum(tree.level_widths) < 50


@pytest.mark.parametrize("count", [collection.MIN_CLASSES, 333, collection.MAX_CLASSES])
def test_names_differ_and_each_has_a_place_on_the_shelves(count):
    names = collection.class_names(count)
    assert len(Taxonomy.flat(names)) == count
    (plan,) = single_room().rooms
    parts = collection.shelves_of_objects(plan, Workshop(np.random.default_rng(0)), names)
    assert {part.class_name for part in parts} == {*names} - {*collection.SHELL_CLASSES[:-1]}
    x0, y0, x1, y1 = plan.bounds_m
    lowest, highest = bounds(parts)
    assert (lowest >= [x0, y0, 0.0]).all()
    assert (highest <= [x1, y1, plan.height_m]).all()


def test_objects_fit_into_their_compartments():
    assert set(collection._SHAPES) == set(SHAPES)
    shop = Workshop(np.random.default_rng(0))
    for name in collection.class_names(200)[len(collection.SHELL_CLASSES) :]:
        low, high = bounds(collection._object(shop, name))
        assert np.allclose(low[2], 0.0)
        assert high[2] < collection._PITCH_M - collection._BOARD_M
        # Also if it is turned by 0.3 rad.
        assert np.hypot(*(high - low)[:2]) < 1.15 * collection._COMPARTMENT_M


def test_objects_of_a_class_look_the_same():
    (plan,) = single_room().rooms
    names = collection.class_names(20)
    parts = collection.shelves_of_objects(plan, Workshop(np.random.default_rng(0)), names)
    cups = [part for part in parts if part.class_name == names[-1]]
    assert len(cups) > 20
    assert len({id(part.texture) for part in cups}) == 1


def test_more_objects_than_compartments_raise():
    (plan,) = single_room().rooms
    names = [f"thing {number}" for number in range(2000)]
    with pytest.raises(ValueError, match="2000 objects do not fit"):
        collection.shelves_of_objects(plan, Workshop(np.random.default_rng(0)), names)
