"""Layouts and textures whose views do not determine the motion: corridor, stop, patterned walls."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.canvas import Canvas
from toolkit.datasets.synthetic_rooms.layouts import (
    LAYOUTS,
    WALL_PAPERS,
    WALL_PERIOD_M,
    Layout,
    Look,
    build_parts,
    build_scene,
)
from toolkit.datasets.synthetic_rooms.long_corridor import (
    BLANK_PANELS,
    DOOR_PITCH_M,
    JOINT_M,
    LENGTH_M,
    PANEL_M,
    corridor_and_hall,
)
from toolkit.datasets.synthetic_rooms.parts import bounds
from toolkit.datasets.synthetic_rooms.paths import STILL_FRAMES, hand_held_path, look_at
from toolkit.datasets.synthetic_rooms.ray_casting import Scene
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_IDS

CAMERA = Camera(64.0, 64.0, 39.5, 29.5, 80, 60)


def painted(texture: tx.Texture, size: tuple[int, int], texel_m: float) -> np.ndarray:
    return texture(Canvas(size, texel_m, np.random.default_rng(0)))


def path(name: str, frames: int = 600) -> np.ndarray:
    layout = LAYOUTS[name]()
    rng = np.random.default_rng(0)
    return hand_held_path(layout.way_points, frames, 1.0, rng, layout.gait)


@pytest.fixture(scope="module")
def corridor() -> Scene:
    """The corridor with its middle doors in the north only, with coarse textures."""
    plan = corridor_and_hall()[0]
    plan = replace(plan, openings=plan.openings[1:3])
    return build_scene(Layout((plan,), (41,), ()), 0, texel_m=0.02)


def sideways(scene: Scene, x: float) -> np.ndarray:
    """The north wall as seen from the middle of the corridor, in grey levels."""
    eye = np.array([x, 0.0, 1.45])
    return 255.0 * scene.render(CAMERA, look_at(eye, np.array([x, 3.0, 1.45]))).rgb


@pytest.mark.parametrize("texel_m", [0.0005, 0.004, 0.01])
def test_joints_have_their_width_also_if_they_are_thinner_than_a_texel(texel_m: float) -> None:
    wall = corridor_and_hall()[0].wall
    assert wall is not None and 0.003 <= JOINT_M <= 0.008
    row = painted(wall, (round(2 * PANEL_M / texel_m), 3), texel_m)[1, :, 0]
    dark_m = (row.max() - row).sum() * texel_m / (row.max() - 0.22)
    assert dark_m == pytest.approx(2 * JOINT_M, rel=0.1)


def test_doors_are_at_equal_distances_and_look_the_same(corridor: Scene) -> None:
    parts = build_parts(LAYOUTS["corridor"](), 0)
    doors = [bounds([part]) for part in parts if part.class_name == "door"]
    north = {round(box.mean(axis=0)[0], 6) for box in doors if 1.0 < box[0, 1] < 1.1}
    middles = [(number - 1.5) * DOOR_PITCH_M for number in range(4)]
    assert {round(x, 6) for x in middles} <= north
    first, second, between = (sideways(corridor, x) for x in (middles[1], middles[2], 0.0))
    assert np.abs(first - second).max() < 3.0  # from the subdivision of the walls
    assert np.abs(first - between).max() > 50.0


def test_the_blank_stretch_has_no_joint(corridor: Scene) -> None:
    blank, edge = (sideways(corridor, x) for x in (0.0, BLANK_PANELS * PANEL_M / 2))
    assert np.abs(np.diff(blank, axis=1)).max() < 1.0
    assert np.abs(np.diff(edge, axis=1)).max() > 10.0


def test_the_camera_walks_to_the_hall_and_back() -> None:
    T = path("corridor")
    x, y = T[:, 0, 3], T[:, 1, 3]
    far = int(np.argmax(x))
    assert x[0] < -6.0 and x[far] > LENGTH_M / 2 + 1.0 and x[-1] < -5.0
    assert T[far // 2, 0, 2] > 0.99 and T[(far + 600) // 2, 0, 2] < -0.99
    assert np.abs(y[np.abs(x) < LENGTH_M / 2]).max() < 0.05
    roll = np.degrees(np.arcsin(T[:, 2, 0]))
    assert 1.0 < np.abs(roll).max() < 4.0


def test_turns_show_both_sides_of_the_corridor() -> None:
    T = path("corridor-turns")
    middle = T[np.abs(T[:, 0, 3]) < 0.2]
    assert (middle[:, 1, 2] > 0.97).all() and len(middle) > 5
    south = T[np.abs(np.abs(T[:, 0, 3]) - DOOR_PITCH_M) < 0.2]
    assert (south[:, 1, 2] < -0.97).all() and len(south) > 10


def test_a_stop_stands_still_and_slows_down_before() -> None:
    T = path("corridor-stop")
    motion = se3.inverse(T[:-1]) @ T[1:]
    step_m = np.linalg.norm(motion[:, :3, 3], axis=1)
    still = np.flatnonzero(step_m < 1e-9)
    assert len(still) == STILL_FRAMES - 1 and np.ptp(still) == STILL_FRAMES - 2
    np.testing.assert_allclose(T[still[0]], T[still[-1] + 1], atol=1e-12)
    assert np.abs(T[still[0], 0, 3]) < LENGTH_M / 2 - 1.0
    around = step_m[still[0] - 20 : still[-1] + 21]
    assert np.abs(np.diff(around)).max() < 0.15 * around.max()


@pytest.mark.parametrize(("frames", "share"), [(1, 1.0), (2, 1.0), (30, 0.1), (40, 0.25)])
def test_short_paths_may_end_before_or_in_the_stop(frames: int, share: float) -> None:
    layout = LAYOUTS["corridor-stop"]()
    T = hand_held_path(layout.way_points, frames, share, np.random.default_rng(0), layout.gait)
    assert T.shape == (frames, 4, 4) and np.isfinite(T).all()


@pytest.mark.parametrize("name", WALL_PAPERS)
def test_wall_papers_repeat_exactly(name: str) -> None:
    period = 32
    image = painted(WALL_PAPERS[name], (4 * period, 4 * period), WALL_PERIOD_M / period)
    np.testing.assert_allclose(image[:, period:], image[:, :-period], atol=1e-5)
    np.testing.assert_allclose(image[2 * period :], image[: -2 * period], atol=1e-5)
    assert np.abs(image[:, period // 2 :] - image[:, : -period // 2]).max() > 0.1


def test_only_walls_are_papered() -> None:
    layout = LAYOUTS["wall"]()
    normal, striped = (build_scene(layout, 0, 0.03, Look(t)) for t in ("normal", "stripes"))
    np.testing.assert_array_equal(normal.vertices_m, striped.vertices_m)
    change = np.abs(normal.vertex_colours() - striped.vertex_colours()).max(axis=1)
    on_walls = normal.triangle_labels == CLASS_IDS["wall"]
    assert (change[normal.triangles[on_walls]] > 0.05).mean() > 0.5
    assert change[normal.triangles[~on_walls]].max() < 0.05
    eye = np.array([0.0, 1.2, 1.45])
    rgb = striped.render(CAMERA, look_at(eye, np.array([0.0, 3.0, 1.45]))).rgb
    assert np.abs(np.diff(rgb, axis=0)).max() < 0.02 < np.abs(np.diff(rgb, axis=1)).max()


def test_the_camera_shows_only_the_wall_for_a_third_of_the_path() -> None:
    T = path("wall")
    facing = T[:, 1, 2] > 0.99
    assert 0.3 < facing.mean() < 0.7
    assert np.ptp(T[facing, 0, 3]) > 2.5 and np.ptp(T[facing, 2, 3]) > 0.2
