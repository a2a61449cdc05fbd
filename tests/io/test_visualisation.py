"""Visualisation: colour maps, and text that is not cut off."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from toolkit.io.visualisation import (
    MISSING,
    DepthSpan,
    Panel,
    colour_image,
    depth_image,
    silhouette_image,
    strip,
    view_strip,
    with_depth_scale,
)


def test_colours_are_clamped_and_rounded():
    rgb = np.array([[[-1.0, 0.5, 2.0]]])
    assert colour_image(rgb).tolist() == [[[0, 128, 255]]]


def test_missing_depth_is_grey_and_far_depth_is_bright():
    depth_m = np.array([[0.0, np.nan, 1.0, 2.0, 3.0]])
    picture = depth_image(depth_m, DepthSpan(1.0, 3.0))
    assert (picture[0, :2] == MISSING).all()
    brightness = picture[0, 2:].astype(int).sum(axis=1)
    assert (np.diff(brightness) > 50).all()


def test_with_one_span_the_colour_of_a_depth_is_the_same_in_all_frames():
    span = DepthSpan.of([np.full((2, 2), 1.0), np.full((2, 2), 4.0)])
    alone = depth_image(np.array([[2.0]]), span)
    among_others = depth_image(np.array([[2.0, 3.7]]), span)
    assert (alone[0, 0] == among_others[0, 0]).all()


@given(st.floats(0.05, 50.0), st.floats(0.0, 20.0))
def test_span_is_rounded_and_covers_the_depths(near_m, length_m):
    span = DepthSpan.of([np.linspace(near_m, near_m + length_m, 1000).reshape(10, 100)])
    # From the 1st to the 99th percentile.
    assert span.near_m <= near_m + 0.011 * length_m + 1e-9
    assert span.far_m >= near_m + 0.989 * length_m - 1e-9
    assert span.far_m - span.near_m <= 2.0 * max(length_m, 0.05 * (near_m + length_m)) + 1e-9


def test_span_without_valid_depth():
    assert DepthSpan.of([np.zeros((3, 3))]) == DepthSpan(0.0, 1.0)
    assert DepthSpan.of([]) == DepthSpan(0.0, 1.0)


def test_invalid_span_raises():
    with pytest.raises(ValueError, match="near < far"):
        DepthSpan(2.0, 2.0)


def test_silhouette_colours_differ_between_empty_and_opaque():
    empty, thin, solid = silhouette_image(np.array([[0.0, 0.5, 1.0]]))[0].astype(int)
    assert tuple(empty) == MISSING
    assert thin[0] > 2 * thin[2]
    assert solid.min() > 250


@pytest.mark.parametrize("height", [24, 60, 240, 720])
def test_scale_bar_is_not_cut_off(height):
    picture = np.zeros((height, 40, 3), np.uint8)
    scaled = with_depth_scale(picture, DepthSpan(0.0, 12.5))
    assert scaled.shape[0] == height
    assert (scaled[:, :40] == 0).all()
    side = scaled[:, 40:]
    # Text at the border would be a label that is cut off.
    assert (side[:, -1] == 255).all()
    assert (side[[0, -1]] == 255).all()
    assert (side < 100).any()


def test_strip_contains_every_picture_unchanged():
    pictures = [np.full((30, width, 3), value, np.uint8) for width, value in ((40, 7), (20, 99))]
    page = strip([Panel("input", pictures[0]), Panel("a caption too long", pictures[1])])
    assert (page == 7).all(axis=2).sum() == 30 * 40
    assert (page == 99).all(axis=2).sum() >= 30 * 20
    assert (page[:, [0, -1]] == 255).all()


def test_strip_of_pictures_with_different_heights_raises():
    with pytest.raises(ValueError, match="one height"):
        strip(
            [Panel("a", np.zeros((2, 2, 3), np.uint8)), Panel("b", np.zeros((3, 2, 3), np.uint8))]
        )


def test_view_strip_shows_the_input_if_given():
    rgb, plane = np.zeros((48, 64, 3)), np.ones((48, 64))
    without = view_strip(rgb, plane, plane)
    with_input = view_strip(rgb, plane, plane, observed=np.full((48, 64, 3), 0.5))
    assert with_input.shape[1] - without.shape[1] > 64
    assert (with_input == 128).all(axis=2).sum() >= 48 * 64
