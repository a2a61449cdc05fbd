"""Completion of depth on planes without texture."""

from __future__ import annotations

import numpy as np
import pytest

from toolkit.depth.depth_priors.plane_completion import FilledHoles, complete

HEIGHT, WIDTH = 90, 120
Y, X = np.mgrid[:HEIGHT, :WIDTH]
WALL = (0.5 + 0.001 * X - 0.0005 * Y).astype(np.float32)
GREY = np.full((HEIGHT, WIDTH), 0.5, np.float32)


def hole(rows: slice, columns: slice, surface: np.ndarray = WALL) -> np.ndarray:
    depth = surface.copy()
    depth[rows, columns] = 0.0
    return depth


def completed(intensity: np.ndarray, inverse_depth: np.ndarray) -> FilledHoles:
    return complete(intensity, inverse_depth, np.random.default_rng(0))


def test_a_hole_of_a_wall_is_completed():
    depth = hole(np.s_[20:70], np.s_[30:90])
    found = completed(GREY, depth)
    inside = depth == 0
    np.testing.assert_allclose(found.inverse_depth[inside], WALL[inside], rtol=1e-4)
    assert (found.relative_sigma[inside] < 0.01).all()


def test_measured_depth_stays():
    depth = hole(np.s_[20:70], np.s_[30:90])
    found = completed(GREY, depth)
    assert not found.inverse_depth[depth > 0].any()
    assert np.isinf(found.relative_sigma[depth > 0]).all()


def test_noise_and_some_wrong_depth_around_the_hole_do_no_harm():
    rng = np.random.default_rng(1)
    noisy = (WALL * (1 + 0.004 * rng.normal(size=WALL.shape))).astype(np.float32)
    noisy[20:30, 20:28] *= 1.5
    depth = hole(np.s_[20:70], np.s_[30:90], noisy)
    found = completed(GREY, depth)
    inside = depth == 0
    error = np.abs(found.inverse_depth[inside] / WALL[inside] - 1)
    assert error.max() < 0.004
    assert (error < found.relative_sigma[inside]).mean() > 0.6


def framed(colour: float = 0.8) -> np.ndarray:
    intensity = GREY.copy()
    intensity[20:70, 30:90] = colour
    return intensity


def test_a_wall_does_not_continue_behind_an_object():
    """The hole belongs to a board of another colour, whose own depth is not known."""
    found = completed(framed(), hole(np.s_[12:78], np.s_[22:98]))
    assert not found.inverse_depth[23:67, 33:87].any()


def test_edges_that_bound_a_plain_door_carry_its_plane():
    inside = np.s_[24:66, 34:86]
    edges = hole(np.s_[:], np.s_[:])
    for rows, columns in ((np.s_[18:22], np.s_[28:92]), (np.s_[68:72], np.s_[28:92])):
        edges[rows, columns] = WALL[rows, columns]
    for columns in (np.s_[28:32], np.s_[88:92]):
        edges[18:72, columns] = WALL[18:72, columns]
    found = completed(framed(), edges)
    np.testing.assert_allclose(found.inverse_depth[inside], WALL[inside], rtol=1e-3)


def test_something_in_front_of_a_wall_does_not_bend_it():
    depth = hole(np.s_[20:70], np.s_[30:90])
    depth[60:, 30:90] = 0.0
    depth[71:85, 30:90] = 1.5 * WALL[71:85, 30:90]
    intensity = GREY.copy()
    intensity[71:85, 30:90] = 0.1
    inside = np.s_[25:65, 35:85]
    found = completed(intensity, depth)
    np.testing.assert_allclose(found.inverse_depth[inside], WALL[inside], rtol=1e-3)


def test_a_surface_is_not_continued_far_beyond_its_known_part():
    depth = hole(np.s_[:], np.s_[20:])
    found = completed(GREY, depth)
    assert (found.inverse_depth[30:60, 20:22] > 0).all()
    assert not found.inverse_depth[:, 60:].any()


def test_curved_surfaces_are_left_alone():
    sphere = (1.0 - 0.4 * np.hypot(X - 60, Y - 45) / 60).astype(np.float32)
    assert not completed(GREY, hole(np.s_[25:65], np.s_[40:80], sphere)).inverse_depth.any()


@pytest.mark.parametrize("textured", [True, False])
def test_holes_with_texture_are_left_alone(textured):
    """Matching should have found depth there: it is hidden, or moves."""
    rng = np.random.default_rng(2)
    intensity = rng.random((HEIGHT, WIDTH), np.float32) if textured else GREY
    found = completed(intensity, hole(np.s_[20:70], np.s_[30:90]))
    assert found.inverse_depth.any() != textured


def test_an_image_without_depth_stays_empty():
    found = completed(GREY, np.zeros_like(GREY))
    assert not found.inverse_depth.any()
