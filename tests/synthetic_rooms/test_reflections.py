"""Glossy rooms: geometry and strength of reflections, and what a depth camera measures."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from toolkit.base.errors import SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.registry import open_dataset
from toolkit.datasets.synthetic_rooms import RoomSettings, SensorModel, finishes, make_room
from toolkit.datasets.synthetic_rooms import textures as tx
from toolkit.datasets.synthetic_rooms.finishes import (
    LACQUER_REFLECTANCE,
    Finish,
    coated,
    reflectance,
)
from toolkit.datasets.synthetic_rooms.parts import Part
from toolkit.datasets.synthetic_rooms.patches import box, plate
from toolkit.datasets.synthetic_rooms.paths import look_at
from toolkit.datasets.synthetic_rooms.ray_casting import RayCastView, Scene
from toolkit.datasets.synthetic_rooms.reflections import Reflection, measured_depth, polished
from toolkit.datasets.synthetic_rooms.vocabulary import GLOSSY_CLASS_NAMES, numbered
from toolkit.datasets.synthetic_rooms.writer import DEPTH_SCALE
from toolkit.tools.cli.main import main as program

CAMERA = Camera(100.0, 100.0, 63.5, 47.5, 128, 96)
LAMPS_M = np.array([[0.0, 0.0, 2.6]])
IDS = numbered(GLOSSY_CLASS_NAMES)
EYE, TARGET = np.array([0.3, -0.2, 0.1]), np.array([-0.1, 2.0, 0.0])
MIRROR_PLANE_M = 2.0


def part(name: str, patches: list, texture: tx.Texture, finish: Finish = Finish.MATT) -> Part:
    return Part(name, patches, texture, np.random.default_rng(0), finish=finish)


def furniture() -> list[Part]:
    """A papered wall behind the camera, and a box beside it."""
    wall = plate((4, -2, 3), (-8, 0, 0), (0, 0, -6))
    return [
        part("wall", [wall], tx.stripes((0.8, 0.7, 0.6), (0.3, 0.4, 0.6), 0.3)),
        part("box", box((0.4, 0.4, 0.7), (-0.4, -0.9, -0.4)), tx.wood((0.6, 0.3, 0.2))),
    ]


def front(finish: Finish) -> Part:
    glass = plate((-0.7, MIRROR_PLANE_M, 0.5), (1.4, 0, 0), (0, 0, -1.0))
    return part("mirror", [glass], tx.plaster((0.3, 0.3, 0.3), 0.0), finish)


def in_front_of_glass(finish: Finish, glossy: bool = True) -> RayCastView:
    scene = Scene(
        [*furniture(), front(finish)], LAMPS_M, 0.01, IDS, LACQUER_REFLECTANCE if glossy else None
    )
    return scene.render(CAMERA, look_at(EYE, TARGET))


@pytest.fixture(scope="module")
def from_behind() -> RayCastView:
    """The furniture as seen by the mirrored camera, without a mirror; left and right exchanged."""
    flip = np.array([1.0, -1.0, 1.0])
    plane = np.array([0.0, 2 * MIRROR_PLANE_M, 0.0])
    scene = Scene(furniture(), LAMPS_M, 0.01, IDS)
    view = scene.render(CAMERA, look_at(flip * EYE + plane, flip * TARGET + plane))
    return replace(view, rgb=view.rgb[:, ::-1], depth_m=view.depth_m[:, ::-1])


def test_a_mirror_shows_what_the_mirrored_camera_sees(from_behind, monkeypatch):
    perfect = finishes._REFLECTANCE.copy()
    perfect[Finish.MIRROR] = 1.0
    monkeypatch.setattr(finishes, "_REFLECTANCE", perfect)
    view = in_front_of_glass(Finish.MIRROR)
    glass = view.reflection.finish == Finish.MIRROR
    assert (view.labels[glass] == IDS["mirror"]).all()
    # Away from the border, which the lens blurs.
    inside = cv2.erode(glass.astype(np.uint8), np.ones((9, 9))) > 0
    assert inside.sum() > 1000
    assert np.abs(view.rgb - from_behind.rgb)[inside].max() < 0.02
    assert np.abs(view.rgb - from_behind.rgb)[inside].mean() < 1e-3
    # The box in front of the wall is in the mirror image.
    image_m = view.reflection.image_m
    assert np.ptp(image_m[inside]) > 0.9
    assert np.abs(image_m - from_behind.depth_m)[inside].mean() < 1e-3
    # A view that is not flipped differs.
    assert np.abs(view.rgb - from_behind.rgb[:, ::-1])[inside].mean() > 0.02


def test_a_real_mirror_is_a_little_darker_and_glass_much(from_behind):
    mean = {}
    for finish in (Finish.MIRROR, Finish.SCREEN):
        view = in_front_of_glass(finish)
        inside = cv2.erode((view.reflection.finish == finish).astype(np.uint8), np.ones((9, 9))) > 0
        mean[finish] = float(view.rgb[inside].mean() / from_behind.rgb[inside].mean())
    assert 0.93 < mean[Finish.MIRROR] < 1.0
    assert mean[Finish.SCREEN] < 0.8


def test_surfaces_are_matt_unless_the_scene_is_glossy():
    matt, other = in_front_of_glass(Finish.MATT, False), in_front_of_glass(Finish.MIRROR, False)
    assert other.reflection is None
    for name in ("rgb", "depth_m", "labels", "cosine"):
        np.testing.assert_array_equal(getattr(matt, name), getattr(other, name))


def test_a_matt_surface_of_a_glossy_scene_reflects_nothing():
    view, matt = in_front_of_glass(Finish.MATT), in_front_of_glass(Finish.MATT, False)
    np.testing.assert_array_equal(view.rgb, matt.rgb)
    assert not view.reflection.finish.any() and not view.reflection.image_m.any()


@pytest.mark.parametrize(
    ("finish", "from_above"), [(Finish.LACQUER, 0.3), (Finish.SCREEN, 0.04), (Finish.MIRROR, 0.92)]
)
def test_reflectance_grows_from_the_front_to_grazing_angles(finish, from_above):
    cosine = np.linspace(0.0, 1.0, 50, dtype=np.float32)
    share = reflectance(np.full(50, finish, np.uint8), cosine, lacquer=0.3)
    assert (np.diff(share) <= 0).all() and share[0] == 1.0
    # A dielectric reflects twice its normal reflectance at 60 degrees or a little more.
    assert share[-1] == pytest.approx(from_above)
    assert not reflectance(np.zeros(50, np.uint8), cosine).any()


def test_coated_colours_lie_between_both():
    rng = np.random.default_rng(0)
    below, above = rng.random((2, 100, 3), dtype=np.float32)
    for share, expected in ((0.0, below), (1.0, above)):
        mixed = coated(below, above, np.full(100, share, np.float32))
        np.testing.assert_allclose(mixed, expected, atol=1e-5)
    half = coated(below, above, np.full(100, 0.5, np.float32))
    assert (half >= np.minimum(below, above)).all() and (half <= np.maximum(below, above)).all()
    # Light adds up, not display values.
    assert (half >= (below + above) / 2 - 1e-5).all()


def test_depth_is_that_of_the_mirror_image_the_floor_or_missing():
    finish = np.array([[Finish.MATT, Finish.LACQUER, Finish.MIRROR, *[Finish.SCREEN] * 3]])
    cosine = np.array([[0.9, 0.9, 0.9, 0.9, 0.6, 0.2]], np.float32)
    surface_m, image_m = np.full((1, 6), 2.0, np.float32), np.full((1, 6), 5.0, np.float32)
    reflection = Reflection(finish.astype(np.uint8), surface_m, image_m)
    measured = measured_depth(reflection, cosine)
    np.testing.assert_array_equal(measured, [[2.0, 2.0, 5.0, 0.0, 2.0, 0.0]])
    # A mirror image out of range is missing, since files of depth end at 10 m.
    far = measured_depth(replace(reflection, image_m=np.full((1, 6), 9.0, np.float32)), cosine)
    np.testing.assert_array_equal(far, [[2.0, 2.0, 0.0, 0.0, 2.0, 0.0]])


def test_a_hung_mirror_has_a_frame_around_its_glass():
    picture = part("picture", box((0.9, 0.025, 0.6)), tx.plaster((1, 0, 0)), Finish.HUNG_MIRROR)
    frame, glass = polished([picture])
    assert (frame.finish, glass.finish) == (Finish.MATT, Finish.MIRROR)
    assert {frame.class_name, glass.class_name} == {"mirror"}
    points = glass.patches[0].points.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    np.testing.assert_allclose(high - low, [0.81, 0.0, 0.51], atol=1e-9)
    np.testing.assert_allclose((high + low)[[0, 2]] / 2, [0.0, 0.3], atol=1e-9)
    # In front of the frame's board, which is at y = -0.0125.
    assert -0.015 < high[1] < -0.0125


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same frames without and with gloss; the camera passes the wardrobe."""
    base = tmp_path_factory.mktemp("rooms")
    settings = RoomSettings(frames=6, share=0.3, width=80, height=60, unseen=1)
    make_room(base / "matt", settings)
    words = ("--frames", "6", "--share", "0.3", "--image-size", "80", "60", "--unseen", "1")
    assert program(["make-room", "--out", str(base / "glossy"), *words, "--glossy"]) == 0
    return {name: base / name for name in ("matt", "glossy")}


def images(folder: Path, pattern: str) -> np.ndarray:
    return np.stack([cv2.imread(str(p), -1) for p in sorted(folder.glob(pattern))])


def test_glossy_rooms_differ_from_matt_ones_on_glossy_surfaces_only(folders):
    finish = images(folders["glossy"], "surface/finish*.png")
    assert {Finish.LACQUER, Finish.SCREEN, Finish.MIRROR} <= set(np.unique(finish))
    matt, glossy = (images(folders[n], "results/frame*.png").astype(int) for n in folders)
    ids = [IDS["mirror"], IDS["tv-screen"], IDS["monitor"]]
    changed = (finish > 0) | np.isin(images(folders["glossy"], "labels/label*.png"), ids)
    near = np.stack([cv2.dilate(c.astype(np.uint8), np.ones((7, 7))) > 0 for c in changed])
    # Charts have other places in the atlas, which changes the coarser levels a little.
    elsewhere = np.abs(glossy - matt)[~near]
    assert (elsewhere > 2).mean() < 0.002 and elsewhere.max() < 15
    assert np.abs(glossy - matt)[finish == Finish.MIRROR].mean() > 20
    depths = images(folders["matt"], "results/depth*"), images(folders["glossy"], "surface/depth*")
    # A mirror's glass lies a millimetre in front of its board.
    assert np.abs(depths[0].astype(int) - depths[1]).max() < 0.003 * DEPTH_SCALE
    for name in ("traj.txt", "cam_params.json", "unseen/traj.txt"):
        assert (folders["matt"] / name).read_bytes() == (folders["glossy"] / name).read_bytes()


def test_recorded_depth_is_measured_and_that_of_unseen_views_true(folders):
    glossy = folders["glossy"]
    finish = images(glossy, "surface/finish*.png")
    measured, true = (images(glossy, f"{f}/depth*.png").astype(int) for f in ("results", "surface"))
    plain = (finish == Finish.MATT) | (finish == Finish.LACQUER)
    np.testing.assert_array_equal(measured[plain], true[plain])
    mirror = finish == Finish.MIRROR
    assert (measured[mirror] > true[mirror] + 0.05 * DEPTH_SCALE).mean() > 0.95
    assert (measured[finish == Finish.SCREEN] == 0).any()
    unseen = glossy / "unseen"
    np.testing.assert_array_equal(
        images(unseen, "results/depth*.png"), images(unseen, "surface/depth*.png")
    )


def test_only_glossy_rooms_have_the_class_mirror(folders):
    assert open_dataset("synthetic", folders["glossy"]).label_names[102] == "mirror"
    assert 102 not in open_dataset("synthetic", folders["matt"]).label_names
    settings = {n: json.loads((folder / "room.json").read_text()) for n, folder in folders.items()}
    more = {"glossy": True, "polish": LACQUER_REFLECTANCE}
    assert settings["glossy"] == {**settings["matt"], **more}
    assert not (folders["matt"] / "surface").exists()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"walker": True}, "glossy cannot be combined with walker or real"),
        ({"polish": 1.0}, r"polish must lie in \(0, 1\), got 1.0"),
        ({"glossy": False, "polish": 0.3}, "polish requires glossy"),
        ({"sensor": SensorModel.of(noise=False, real=True), "walker": True}, "walker or real"),
        ({"classes": 30}, "glossy cannot be combined with classes"),
    ],
)
def test_what_has_no_reflection_is_refused(values, message):
    with pytest.raises(SettingsError, match=message):
        RoomSettings(**{"glossy": True, **values})
