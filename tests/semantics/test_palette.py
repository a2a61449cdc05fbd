"""Colours of a tree: distinct, in families, the same each time; and what pictures show."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from toolkit.io.visualisation import LegendEntry, legend_below, with_legend
from toolkit.semantics import palette as palette_module
from toolkit.semantics.palette import _CONES_FROM_RGB, _LAB_FROM_CONES, Palette, instance_colours
from toolkit.semantics.taxonomy import Taxonomy


def oklab(rgb: NDArray[np.integer]) -> NDArray[np.float64]:
    """Lightness, a and b [N, 3] of sRGB colours [N, 3] in 0..255; distance is contrast.

    About 0.02 is just visible. Source: B. Ottosson, "A perceptual color space for
    image processing" (2020).
    """
    values = np.asarray(rgb) / 255.0
    linear = np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)
    return np.cbrt(linear @ _CONES_FROM_RGB.T) @ _LAB_FROM_CONES.T


def even_tree(*widths: int) -> Taxonomy:
    """A tree whose nodes have so many children, level by level."""

    def branch(depth: int, name: str) -> dict:
        if depth == len(widths):
            return {}
        names = [f"{name}.{i}" for i in range(widths[depth])]
        return {child: branch(depth + 1, child) for child in names}

    return Taxonomy(branch(0, "n"))


ROOM = Taxonomy(
    {
        "large items": {"furniture": {"round": ["table"], "square": ["bed", "sofa"]}},
        "small items": {"dishes": {"round": ["cup", "plate"]}, "toys": ["ball"]},
    },
    levels=["size", "function", "shape", "class"],
)


def nearest(colours: np.ndarray) -> float:
    """The smallest contrast between any two colours."""
    lab = oklab(colours)
    distance = np.linalg.norm(lab[:, None] - lab[None], axis=2)
    return float(distance[~np.eye(len(lab), dtype=bool)].min())


def hues(colours: np.ndarray) -> np.ndarray:
    lab = oklab(colours)
    return np.arctan2(lab[:, 2], lab[:, 1])


@pytest.mark.parametrize(
    ("colour", "lab"),
    [
        ((255, 255, 255), (1.0, 0.0, 0.0)),
        ((0, 0, 0), (0.0, 0.0, 0.0)),
        # CSS Color 4 gives oklch(0.628 0.2577 29.23) for pure red.
        ((255, 0, 0), (0.6280, 0.2249, 0.1258)),
    ],
)
def test_oklab_has_the_published_values(colour, lab):
    np.testing.assert_allclose(oklab(np.array([colour]))[0], lab, atol=2e-4)


def test_colours_are_the_same_each_time():
    first = Palette(even_tree(3, 3, 11)).nodes
    palette_module._candidates.cache_clear()
    palette_module._node_colours.cache_clear()
    np.testing.assert_array_equal(Palette(even_tree(3, 3, 11)).nodes, first)


def test_void_is_black_and_nothing_else_is_near_it():
    palette = Palette(even_tree(3, 3, 11))
    assert palette.classes.shape == (100, 3)
    assert (palette.classes[0] == 0).all()
    assert oklab(palette.nodes)[:, 0].min() > 0.35
    assert oklab(palette.nodes)[:, 0].max() < 0.95


@pytest.mark.parametrize(
    ("tree", "least"),
    [
        (even_tree(101), 0.06),
        (even_tree(3, 3, 3, 4), 0.06),
        (even_tree(4, 4, 6, 6), 0.02),  # 576 classes: just visible
        (even_tree(5), 0.25),
    ],
)
def test_classes_differ_visibly(tree, least):
    assert nearest(Palette(tree).classes[1:]) > least


def test_groups_of_every_level_differ_more_than_classes():
    tree = even_tree(3, 3, 3, 4)
    palette = Palette(tree)
    contrast = [nearest(palette.nodes[np.unique(tree.node_ids[:, i])]) for i in range(4)]
    assert contrast[0] > 0.3
    assert contrast[1] > 0.15
    assert contrast[2] > 0.08


@pytest.mark.parametrize("tree", [even_tree(3, 3, 3, 4), even_tree(4, 2, 5), even_tree(2, 3, 4)])
def test_the_families_of_the_top_are_arcs_of_hue(tree):
    hue = hues(Palette(tree).classes[1:])
    family = tree.node_ids[np.argsort(hue), 0]
    changes = (family != np.roll(family, 1)).sum()
    assert changes == len(tree.nodes_at(0))


def test_a_group_has_a_hue_of_its_family():
    tree = even_tree(4, 3, 5)
    palette = Palette(tree)
    for number, node in enumerate(tree.nodes):
        if node.level == 0:
            own = np.exp(1j * hues(palette.classes[list(node.class_ids)]))
            spread = np.abs(np.angle(own / own.mean())).max()
            offset = np.abs(np.angle(np.exp(1j * hues(palette.nodes[[number]])) / own.mean()))
            assert offset[0] < spread


@settings(max_examples=20)
@given(st.integers(2, 6), st.integers(1, 5), st.integers(1, 4))
def test_any_tree_gets_colours_that_differ(first, second, third):
    palette = Palette(even_tree(first, second, third))
    assert len(np.unique(palette.classes, axis=0)) == len(palette.classes)


def test_more_classes_than_colours_still_have_some(monkeypatch):
    few = [values[::200] for values in palette_module._candidates()]
    monkeypatch.setattr(palette_module, "_candidates", lambda: few)
    count = 2 * len(few[0])
    assert Palette(even_tree(count)).classes.shape == (count + 1, 3)


def test_a_picture_has_the_colour_of_each_node_and_black_for_void():
    palette = Palette(ROOM)
    labels = np.array([[0, 1, 2], [3, 4, 6]])
    for level in range(ROOM.depth):
        node_ids = ROOM.level_ids(labels, level)
        picture = palette.class_image(node_ids)
        assert (picture[0, 0] == 0).all()
        np.testing.assert_array_equal(picture[1, 2], palette.nodes[ROOM.node_ids[5, level]])
    np.testing.assert_array_equal(
        palette.class_image(ROOM.level_ids(labels, 3)), palette.classes[labels]
    )


def test_a_legend_is_ordered_by_share_with_void_last():
    labels = np.zeros((10, 100), int)
    labels[:, :20] = 4
    labels[:, 20:50] = 1
    labels[0, 99] = 2
    legend = Palette(ROOM).legend(ROOM.level_ids(labels, 3))
    assert [e.text for e in legend] == ["table 30.0 %", "cup 20.0 %", "bed 0.1 %", "void 49.9 %"]
    assert legend[0].colour == tuple(Palette(ROOM).classes[1])
    assert legend[-1].colour == (0, 0, 0)


def test_names_of_several_groups_are_made_unique():
    legend = Palette(ROOM).legend(ROOM.level_ids(np.array([[1, 2, 4, 6]]), 2))
    names = {entry.text.removesuffix(" 25.0 %") for entry in legend}
    assert names == {"furniture > round", "dishes > round", "square", "ball"}


def test_tiny_shares_are_not_zero():
    labels = np.ones((100, 100), int)
    labels[0, 0] = 2
    assert Palette(ROOM).legend(ROOM.level_ids(labels, 3))[-1].text == "bed < 0.1 %"


@pytest.mark.parametrize("height", [24, 60, 240, 720])
@pytest.mark.parametrize("count", [1, 7, 200])
def test_a_legend_beside_a_picture_is_whole(height, count):
    picture = np.full((height, 40, 3), 9, np.uint8)
    entries = [LegendEntry(f"class number {i} 1.0 %", (200, 30, 30)) for i in range(count)]
    page = with_legend(picture, entries)
    assert page.shape[0] == height
    assert (page[:, :40] == 9).all()
    # Ink on the border would be a line that is cut off.
    assert (page[:, -1] == 255).all()
    assert (page[-1, 40:] == 255).all()


def test_what_a_legend_has_no_room_for_is_counted():
    picture = np.zeros((100, 40, 3), np.uint8)
    colours = [(10 * i, 255, 7) for i in range(20)]
    page = with_legend(picture, [LegendEntry("x", c) for c in colours], columns=1)
    shown = [c for c in colours if (page == c).all(axis=2).any()]
    assert shown == colours[: len(shown)]
    assert 2 < len(shown) < 10
    all_of_them = with_legend(picture, [LegendEntry("x", c) for c in colours[: len(shown) + 1]])
    assert sum((all_of_them == c).all(axis=2).any() for c in colours) == len(shown) + 1


def test_a_legend_below_keeps_the_width_and_its_height():
    picture = np.zeros((100, 60, 3), np.uint8)
    entries = [LegendEntry("a class with a very long name 12.3 %", (200, 30, 30))] * 3
    heights = {legend_below(picture, entries[:n], rows=4).shape for n in range(4)}
    assert len(heights) == 1
    assert heights.pop()[1] == 60
    assert (legend_below(picture, entries, rows=4)[100:, -1] == 255).all()
    np.testing.assert_array_equal(legend_below(picture, entries, rows=0), picture)


def test_a_level_strip_shows_every_level_under_its_name():
    palette = Palette(ROOM)
    labels = np.ones((48, 64), int)
    levels = [ROOM.level_ids(labels, i) for i in range(4)]
    page = palette.level_strip(np.full((48, 64, 3), 0.5), levels)
    assert (page == 128).all(axis=2).sum() >= 48 * 64
    for i in range(4):
        colour = palette.nodes[ROOM.node_ids[0, i]]
        assert (page == colour).all(axis=2).sum() >= 48 * 64


def test_objects_with_similar_numbers_have_different_colours():
    colours = instance_colours(60).astype(int)
    assert colours.shape == (61, 3)
    assert not colours[0].any()
    for number in range(1, 61):
        near = colours[max(1, number - 40) : number]
        if len(near):
            assert np.abs(near - colours[number]).max(axis=1).min() >= 25
