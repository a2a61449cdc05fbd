"""The object that the page chooses for a Gaussian at a place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from browser_pages import WatchedPage, chromium
from painted_scenes import two_panels

from toolkit.tools.viewer.html import write_page
from toolkit.tools.viewer.scene import ShownObject

CHAIR, SOFA = ("furniture", "seat", "chair"), ("furniture", "seat", "sofa")


def box(number: int, low: float, high: float, path: tuple[str, ...] = CHAIR) -> ShownObject:
    """A cube from one corner to the other."""
    corners_m = np.array([[(low, high)[i >> a & 1] for a in range(3)] for i in range(8)])
    return ShownObject(number, f"object {number}", "room 1", corners_m, path=path)


def grown(number: int, low: float, high: float, path: tuple[str, ...] = CHAIR) -> ShownObject:
    """A cube whose voxels lie on one of its diagonals only."""
    steps = np.arange(low, high + 0.001, 0.05)
    return replace(box(number, low, high, path), voxels_m=np.stack([steps] * 3, axis=1))


@pytest.fixture(scope="module")
def browser():
    with chromium() as started:
        yield started


@pytest.fixture
def choose(browser, tmp_path):
    """A function that returns the number of the object of a Gaussian."""

    def found(objects: list[ShownObject], position, path: tuple[str, ...]) -> int | None:
        if pages.get("objects") is not objects:
            write_page(tmp_path / "page.html", replace(two_panels(8), objects=tuple(objects)))
            watched.page.goto((tmp_path / "page.html").as_uri())
            pages["objects"] = objects
        gaussian = {"position": list(map(float, position)), "classPath": list(path)}
        return watched.page.evaluate(
            "gaussian => objectOf(semsplatViewer.scene, gaussian)?.number", gaussian
        )

    pages: dict[str, list[ShownObject]] = {}
    watched = WatchedPage(browser, evaluate=True)
    yield found
    assert watched.errors == []
    watched.page.close()


def test_it_is_the_one_with_the_nearest_voxel(choose):
    chairs = [grown(3, 0.0, 1.0), grown(5, 0.92, 2.0)]
    assert choose(chairs, (0.5, 0.52, 0.5), CHAIR) == 3
    assert choose(chairs, (1.4, 1.42, 1.4), CHAIR) == 5
    nearest = [choose(chairs, (x, x, x), CHAIR) for x in (0.95, 0.97, 1.0, 1.02)]
    assert nearest == [3, 5, 3, 5]
    assert choose(chairs, (0.8, 0.2, 0.5), CHAIR) is None, "in the box, far from all voxels"
    assert choose(chairs, (0.5, 0.5, 9.0), CHAIR) is None
    assert choose([], (0.5, 0.5, 0.5), CHAIR) is None


def test_its_class_agrees_with_what_is_known_of_the_gaussian(choose):
    """The sofa is nearer than the chair."""
    objects = [grown(3, 0.0, 1.0, CHAIR), grown(5, 0.03, 1.03, SOFA)]
    paths = (CHAIR, SOFA, CHAIR[:2], (), ("structure",), (*CHAIR, "x"))
    numbers = [choose(objects, (0.53, 0.53, 0.53), path) for path in paths]
    assert numbers == [3, 5, 5, 5, None, None]


def test_boxes_are_used_where_voxels_are_unknown(choose):
    objects = [box(1, 0.0, 2.0), box(2, 0.5, 1.0), box(3, 0.6, 0.9, SOFA), grown(4, 5.0, 6.0)]
    assert choose(objects, (0.7, 0.7, 0.7), CHAIR) == 2, "the smallest one of its class"
    assert choose(objects, (1.5, 1.5, 1.5), CHAIR) == 1
    assert choose(objects, (2.05, 1.0, 1.0), CHAIR) == 1, "a little outside"
    assert choose(objects, (2.2, 1.0, 1.0), CHAIR) is None
    assert choose(objects, (0.7, 0.7, 0.7), ()) is None, "what is under a table is not the table"
    assert choose(objects, (5.5, 5.5, 5.5), ()) == 4


def test_turned_and_flat_boxes_contain_what_lies_in_them(choose):
    turn = np.array([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    flat = box(1, 0.0, 1.0).corners_m * (1.0, 1.0, 0.0) @ turn.T
    objects = [ShownObject(1, "picture 1", "", flat, path=CHAIR)]
    inside = turn @ (0.9, 0.1, 0.05)
    assert choose(objects, inside, CHAIR) == 1
    assert choose(objects, inside + np.array([0.0, 0.0, 0.2]), CHAIR) is None
    assert choose(objects, turn @ (0.9, -0.2, 0.0), CHAIR) is None
