"""Floor, wall, ceiling, surface, object: against a room of boxes, where all is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from box_room import CEILING, FLOOR, OBJECT, SURFACE, WALL, LabelledView, looking, see, walk

from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.datasets.registry import open_dataset
from toolkit.semantics.segmenters.geometric import CLASS_NAMES, GeometricSegmenter


def segmented(
    segmenter: GeometricSegmenter, views: Iterable[LabelledView], first: LabelledView | None = None
) -> list[np.ndarray]:
    """Labels of frames in the frame of the first camera, as SLAM has its map."""
    views = list(views)
    T_map_world = se3.inverse((first or views[0]).T_world_camera)
    return [segmenter.segment(s.frame, T_map_world @ s.T_world_camera) for s in views]


def accuracy(views: list[LabelledView], labels: list[np.ndarray]) -> float:
    right = [
        (found == s.classes)[s.frame.depth_m > 0] for s, found in zip(views, labels, strict=True)
    ]
    return float(np.concatenate(right).mean())


def iou(views: list[LabelledView], labels: list[np.ndarray], number: int) -> float:
    true = np.stack([s.classes for s in views]) == number
    found = np.stack(labels) == number
    return float((true & found).sum() / (true | found).sum())


def up_error_deg(segmenter: GeometricSegmenter, first: LabelledView) -> float:
    true = first.T_world_camera[:3, :3].T @ [0.0, 0.0, 1.0]
    return float(np.rad2deg(np.arccos(np.clip(segmenter._room.up.direction @ true, -1.0, 1.0))))


def test_a_room_is_taken_apart():
    views, segmenter = walk(), GeometricSegmenter()
    labels = segmented(segmenter, views)
    assert accuracy(views, labels) > 0.97
    assert iou(views, labels, FLOOR) > 0.95
    assert iou(views, labels, WALL) > 0.95
    assert iou(views, labels, SURFACE) > 0.8
    assert iou(views, labels, OBJECT) > 0.85
    assert up_error_deg(segmenter, views[0]) < 0.5
    assert segmenter._room.floor_height_m == pytest.approx(-1.5, abs=0.02)
    assert set(CLASS_NAMES) == {FLOOR, WALL, CEILING, SURFACE, OBJECT}


def test_the_ceiling_is_found_when_it_comes_into_view():
    views = [*walk(4), see(looking((0.0, -0.6, 1.5), (1.0, 1.5, 2.4)))]
    labels = segmented(GeometricSegmenter(), views)
    assert iou(views[-1:], labels[-1:], CEILING) > 0.95


@pytest.mark.parametrize("roll_deg", [-40.0, -20.0, 20.0, 40.0])
def test_a_tilted_camera_changes_nothing(roll_deg):
    views, segmenter = walk(8, roll_deg), GeometricSegmenter()
    labels = segmented(segmenter, views)
    assert up_error_deg(segmenter, views[0]) < 1.0
    assert accuracy(views[1:], labels[1:]) > 0.95


@pytest.mark.parametrize(
    ("roll_deg", "side"), [(90.0, "left"), (180.0, "bottom"), (-90.0, "right")]
)
def test_another_side_of_the_images_may_be_up(roll_deg, side):
    views, segmenter = walk(8, roll_deg), GeometricSegmenter(side=side)
    labels = segmented(segmenter, views)
    assert up_error_deg(segmenter, views[0]) < 1.0
    assert accuracy(views[1:], labels[1:]) > 0.95


def test_a_camera_may_look_straight_down():
    down = np.diag([1.0, -1.0, -1.0])
    tilts = [se3.exp_so3(np.array([0.05 * (i % 3 - 1), 0.0, 0.0])) for i in range(5)]
    eyes = [np.array([0.2 * i - 0.6, -0.8, 2.2]) for i in range(5)]
    views = [
        see(se3.from_rotation_translation(down @ tilt, eye))
        for tilt, eye in zip(tilts, eyes, strict=True)
    ]
    labels = segmented(GeometricSegmenter(side="backward"), views)
    assert accuracy(views, labels) > 0.95


def test_a_noisy_sensor_with_holes_changes_little():
    generator = np.random.default_rng(0)
    noisy = []
    for view in walk():
        depth = view.frame.depth_m
        sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
        depth = depth + sigma * generator.normal(size=depth.shape)
        depth[generator.random(depth.shape) < 0.05] = 0.0
        noisy.append(replace(view, frame=replace(view.frame, depth_m=depth.astype(np.float32))))
    labels = segmented(GeometricSegmenter(), noisy)
    assert accuracy(noisy, labels) > 0.94


def above_the_table() -> LabelledView:
    """The table's top and nothing else."""
    view = see(looking((0.0, 0.85, 1.3), (0.0, 0.9, 0.75)))
    assert (view.classes == SURFACE).all()
    return view


def test_a_table_that_fills_the_view_is_not_the_floor():
    views = [*walk(6), above_the_table()]
    labels = segmented(GeometricSegmenter(), views)
    assert (labels[-1] == SURFACE).mean() > 0.95


def test_a_first_view_that_misleads_is_put_right():
    views = [above_the_table(), *walk(8)]
    segmenter = GeometricSegmenter()
    labels = segmented(segmenter, views)
    assert (labels[0] != SURFACE).any()  # one view may as well show a wall or a floor
    assert up_error_deg(segmenter, views[0]) < 1.0
    assert segmenter._room.floor_height_m == pytest.approx(-1.3, abs=0.03)
    assert accuracy(views[4:], labels[4:]) > 0.95


def test_a_cupboard_is_no_wall_even_from_so_near_that_its_top_is_out_of_view():
    views = [*walk(), see(looking((0.9, -0.5, 1.3), (1.9, -0.5, 1.2)))]
    labels = segmented(GeometricSegmenter(), views)
    front = views[-1].classes == OBJECT
    assert front.mean() > 0.9
    assert (labels[-1][front] == OBJECT).mean() > 0.95


def test_pixels_without_depth_are_void_and_no_others():
    view = walk(1)[0]
    depth = view.frame.depth_m.copy()
    depth[20:60, 30:90] = 0.0
    labels = GeometricSegmenter().segment(replace(view.frame, depth_m=depth), np.eye(4))
    assert not labels[depth == 0].any()
    assert (labels[depth > 0] > 0).all()


def test_scattered_holes_of_a_large_image_are_void():
    camera = Camera(512.0, 512.0, 319.5, 239.5, 640, 480)
    view = walk(1, camera=camera)[0]
    depth = view.frame.depth_m.copy()
    depth[np.random.default_rng(0).random(depth.shape) < 0.05] = 0.0
    labels = GeometricSegmenter().segment(replace(view.frame, depth_m=depth), np.eye(4))
    np.testing.assert_array_equal(labels == 0, depth == 0)


def test_a_frame_without_any_depth_is_void_and_teaches_nothing():
    segmenter = GeometricSegmenter()
    blank = replace(walk(1)[0].frame, depth_m=np.zeros((120, 160), np.float32))
    before = segmenter.state()
    assert not segmenter.segment(blank, np.eye(4)).any()
    assert_same_state(segmenter.state(), before)


def assert_same_state(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert found.keys() == expected.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(found[name], array, err_msg=name)


def test_a_resumed_run_gives_the_same_labels_to_the_bit():
    views = walk(8)
    whole = GeometricSegmenter()
    expected = segmented(whole, views)
    first = GeometricSegmenter()
    segmented(first, views[:4])
    saved = {name: array.copy() for name, array in first.state().items()}
    assert all(np.issubdtype(a.dtype, np.floating) for a in saved.values())
    resumed = GeometricSegmenter()
    resumed.restore(saved)
    again = segmented(resumed, views[4:], views[0])
    np.testing.assert_array_equal(again, expected[4:])
    assert_same_state(resumed.state(), whole.state())


def test_a_state_is_a_copy():
    views, segmenter = walk(4), GeometricSegmenter()
    segmented(segmenter, views[:2])
    saved = segmenter.state()
    kept = {name: array.copy() for name, array in saved.items()}
    segmented(segmenter, views[2:], views[0])
    assert_same_state(saved, kept)


def test_without_a_pose_a_frame_stands_for_itself():
    views, segmenter = walk(4), GeometricSegmenter()
    segmented(segmenter, views[:2])
    before = segmenter.state()
    labels = [segmenter.segment(s.frame) for s in views]
    assert_same_state(segmenter.state(), before)
    assert accuracy(views, labels) > 0.9


def test_larger_images_have_sharper_borders_than_the_grid():
    camera = Camera(512.0, 512.0, 319.5, 239.5, 640, 480)
    views = walk(3, camera=camera)
    labels = segmented(GeometricSegmenter(), views)
    assert accuracy(views, labels) > 0.97


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (16, 12), (41, 7), (7, 200)])
def test_any_size_has_labels(size):
    camera = Camera(size[0], size[0], (size[0] - 1) / 2, (size[1] - 1) / 2, *size)
    view = see(looking((0.0, -0.6, 1.5), (0.5, 1.0, 0.8)), camera)
    labels = GeometricSegmenter().segment(view.frame, np.eye(4))
    assert labels.shape == (size[1], size[0])
    assert (labels > 0).all()


def test_a_real_office_by_the_names_of_its_labels(real_data):
    dataset = open_dataset("replica", real_data("replica_office0"), (300, 170))
    names = dataset.label_names
    groups = {FLOOR: ("floor", "rug"), WALL: ("wall", "door", "blinds"), CEILING: ("ceiling",)}
    segmenter, right, total = GeometricSegmenter(), 0, 0
    poses = dataset.ground_truth.T_world_camera
    for index in range(0, len(dataset), 4):
        frame: Frame = dataset[index]
        labels = segmenter.segment(frame, se3.inverse(poses[0]) @ poses[index])
        for ours, wanted in groups.items():
            ids = [number for number, name in names.items() if name in wanted]
            true = np.isin(frame.labels, ids) & (frame.depth_m > 0)
            right += int((labels[true] == ours).sum())
            total += int(true.sum())
    assert right / total > 0.94
