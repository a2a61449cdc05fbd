"""Depth, labels and colour of views of simple and furnished scenes."""

import cv2
import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.synthetic_rooms import atlas
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.layouts import LAYOUTS, build_parts
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.patches import box, plate
from toolkit.datasets.synthetic_rooms.paths import hand_held_path, look_at
from toolkit.datasets.synthetic_rooms.ray_casting import Scene
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS
from toolkit.datasets.synthetic_rooms.writer import DEPTH_SCALE

CAMERA = Camera(100.0, 100.0, 63.5, 47.5, 128, 96)
NO_LAMPS = np.array([[0.0, 0.0, 3.0]])


def _part(name, patches, texture=None):
    return Part(name, patches, texture or tx.plaster((0.5, 0.5, 0.5)), np.random.default_rng(0))


@pytest.fixture(scope="module")
def wall_and_box():
    """A wall at y = 2 and a box in front of it."""
    wall = plate((-4, 2, 3), (8, 0, 0), (0, 0, -6))
    return Scene(
        [_part("wall", [wall]), _part("box", box((0.6, 0.4, 0.6), (0.19, 1.0, -0.3)))],
        NO_LAMPS,
        0.02,
    )


@pytest.mark.parametrize("yaw", [0.0, 0.5, -0.6])
def test_depth_of_the_wall_is_accurate_to_a_millimetre(wall_and_box, yaw):
    T = look_at(np.array([0.1, 0.0, 0.2]), np.array([0.1 + np.sin(yaw), np.cos(yaw), 0.1]))
    view = wall_and_box.render(CAMERA, T)
    written = np.round(view.depth_m * DEPTH_SCALE) / DEPTH_SCALE
    points = se3.transform_points(T, CAMERA.unproject(written))
    on_wall = view.labels == CLASS_IDS["wall"]
    assert on_wall.sum() > 1000
    # A half-pixel offset or ray length instead of z-depth would cause errors of centimetres.
    assert np.abs(points[on_wall, 1] - 2.0).max() < 1e-3


def test_labels_change_where_depth_changes(wall_and_box):
    view = wall_and_box.render(CAMERA, look_at(np.zeros(3), np.array([0.0, 1.0, 0.0])))
    assert set(np.unique(view.labels)) == {CLASS_IDS["wall"], CLASS_IDS["box"]}
    assert view.depth_m[view.labels == CLASS_IDS["box"]].max() < 1.25
    assert view.depth_m[view.labels == CLASS_IDS["wall"]].min() > 1.95


def test_corner_of_the_box_is_at_its_projection(wall_and_box):
    T = look_at(np.zeros(3), np.array([0.0, 1.0, 0.0]))
    box_columns = np.flatnonzero((wall_and_box.render(CAMERA, T).labels == CLASS_IDS["box"])[48])
    corners = np.array([[-0.11, 0.8, 0.0], [0.49, 0.8, 0.0]])
    left, right = CAMERA.project(se3.transform_points(se3.inverse(T), corners))[:, 0]
    assert box_columns[0] == np.ceil(left)
    assert box_columns[-1] == np.floor(right)


def test_views_inside_a_room_have_no_void(scene, layout):
    for T in hand_held_path(layout.way_points, 5, 1.0, np.random.default_rng(0)):
        view = scene.render(CAMERA, T)
        assert (view.labels > 0).all()
        assert (view.depth_m > 0.3).all()
        assert 0.2 < view.rgb.mean() < 0.7
        assert view.rgb.std() > 0.08


def test_two_views_agree_on_the_colour_of_a_surface(scene, layout):
    first, second = hand_held_path(layout.way_points, 300, 1.0, np.random.default_rng(0))[
        [100, 108]
    ]
    seen, other = scene.render(CAMERA, first), scene.render(CAMERA, second)
    points = se3.transform_points(se3.inverse(second) @ first, CAMERA.unproject(seen.depth_m))
    place = CAMERA.project(points).astype(np.float32)
    moved = cv2.remap(other.rgb, place, None, cv2.INTER_LINEAR)
    depth = cv2.remap(other.depth_m, place, None, cv2.INTER_LINEAR)
    # Excludes edges, so that both views show the same surface.
    same = np.abs(depth - points[..., 2]) < 0.01
    assert same.mean() > 0.6
    assert np.abs(moved - seen.rgb)[same].mean() < 0.015
    assert np.abs(moved - seen.rgb)[~same].mean() > 0.03


def test_colour_is_averaged_over_pixels_but_labels_are_not_mixed(wall_and_box):
    T = look_at(np.zeros(3), np.array([0.05, 1.0, 0.03]))
    coarse = wall_and_box.render(CAMERA, T, samples=1)
    fine = wall_and_box.render(CAMERA, T, samples=3)
    assert (coarse.labels == fine.labels).all()
    assert (coarse.depth_m == fine.depth_m).all()
    assert np.abs(coarse.rgb - fine.rgb).max() > 0.01


def test_texture_position_follows_its_chart():
    def halves(canvas):
        u, _ = canvas.coordinates()
        return canvas.flat((0.1, 0.1, 0.1)) + canvas.inside(u - 1.0)[..., None] * 0.7

    # From the front, the left metre of the plate is dark and the right metre bright.
    front = plate((-1, 2, 1), (2, 0, 0), (0, 0, -2))
    scene = Scene([_part("picture", [front], halves)], NO_LAMPS, 0.004)
    view = scene.render(CAMERA, look_at(np.zeros(3), np.array([0.0, 1.0, 0.0])))
    row = view.rgb[48, :, 0]
    left, right = row[30], row[97]
    edge = np.interp((left + right) / 2, row[60:68], np.arange(60, 68))
    assert right > 3 * left
    assert edge == pytest.approx(CAMERA.cx, abs=0.15)


def test_large_scenes_have_a_wider_atlas_and_then_larger_texels(monkeypatch):
    sizes = [(3000, 3000)] * 12
    monkeypatch.setattr(atlas, "_MAX_ROWS", 60_000)
    assert atlas._packed(sizes)[1:] == (4096, 36000)
    monkeypatch.setattr(atlas, "_MAX_ROWS", 32767)
    corners, columns, rows = atlas._packed(sizes)
    assert (columns, rows) == (8192, 18000) and len(set(corners)) == 12
    assert atlas._packed(sizes * 9) is None

    parts = build_parts(LAYOUTS["room"](), 0)
    fine, _ = atlas.paint_atlas(parts, 0.02)
    monkeypatch.setattr(atlas, "_MAX_ROWS", fine.image.shape[0] // 2)
    monkeypatch.setattr(atlas, "_WIDTHS", (fine.image.shape[1],))
    coarse, _ = atlas.paint_atlas(parts, 0.02)
    assert coarse.texel_m > fine.texel_m == 0.02
    assert coarse.image.shape[0] < fine.image.shape[0] // 2
