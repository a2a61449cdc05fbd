"""Gaussians in space that keyframes measured as empty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap

from tests.mapping.conftest import MappedRoom
from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.base.native import available_instruction_sets, load_variant
from toolkit.runs.evaluation.free_space import free_space_metrics
from toolkit.slam.mapping import depth_views, free_space
from toolkit.slam.mapping.depth_views import DepthView, DepthViews, depth_confidence, empty_depth
from toolkit.slam.mapping.free_space import Evidence, FreeSpace, hides_view, is_measured
from toolkit.slam.mapping.options import MapperOptions
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.gaussians.scene import InMemoryScene

CAMERA = Camera(40.0, 40.0, 20.0, 15.0, 40, 30)


def wall(depth_m: float = 2.0, index: int = 0, **changed) -> Keyframe:
    """A keyframe at the origin in front of a wall."""
    image = np.full((30, 40), depth_m, np.float32)
    frame = Frame(index, float(index), np.full((30, 40, 3), 0.5, np.float32), image, CAMERA)
    return Keyframe.from_frame(replace(frame, **changed), np.eye(4))


def points(*depths_m: float) -> torch.Tensor:
    """Points on the optical axis."""
    return torch.tensor([[0.0, 0.0, z] for z in depths_m])


def test_what_is_in_front_of_a_measured_surface_is_empty_beyond_a_margin():
    evidence = Evidence.of(points(1.0, 1.9, 1.97, 2.0, 2.05, 3.0, -1.0), [DepthView.of(wall())])
    assert (evidence.through > 0).tolist() == [True, True] + 5 * [False]
    assert evidence.support.tolist() == [0, 0, 1, 1, 1, 0, 0]


def test_the_depth_of_a_prior_rules_out_nothing():
    prior = wall(index=1)
    prior.prior_m = prior.depth_m
    mapper = MappedSubmap(MapperOptions(first_iterations=1, iterations=1))
    mapper.add_keyframe(wall(1.0))
    mapper.add_keyframe(prior)
    assert is_measured(mapper.keyframes[:1])
    assert not is_measured(mapper.keyframes)
    # A measured keyframe at the same place sees through all of the first wall.
    assert (mapper.gaussians.means[:, 2] < 1.5).sum() > 100


def test_pixels_beside_edges_and_holes_do_not_rule_out_space():
    depth_m = np.full((30, 40), 2.0, np.float32)
    depth_m[:, 20:] = 1.0
    depth_m[0, 0] = 0.0
    empty = empty_depth(depth_m)
    assert empty[15, 18] == pytest.approx(1.94) and empty[15, 19] == pytest.approx(0.95)
    assert empty[1, 1] == 0.0 and empty[2, 2] > 0.0


def test_confidence_falls_with_distance_and_obliqueness():
    rays = CAMERA.rays()
    facing = np.full((30, 40), 2.0, np.float32)
    # The plane x + z = 2 is seen at 45 degrees in the centre of the image.
    oblique = (2.0 / (1.0 + rays[..., 0])).astype(np.float32)
    centre = (15, 20)
    assert depth_confidence(facing, CAMERA)[centre] == pytest.approx(1.0)
    assert depth_confidence(oblique, CAMERA)[centre] == pytest.approx(0.707, abs=0.02)
    assert depth_confidence(3 * facing, CAMERA)[centre] == pytest.approx(0.25)
    assert depth_confidence(0 * facing, CAMERA)[centre] == 0.0


def test_a_keyframe_that_contradicts_most_of_the_map_counts_little():
    cloud = torch.cat([points(*9 * [2.0]), points(1.0)])
    good = Evidence.of(cloud, [DepthView.of(wall(2.0))]).through[-1]
    # The same keyframe, moved back by a wrong pose, measures through the whole map.
    bad = Evidence.of(cloud, [DepthView.of(wall(2.5))]).through[-1]
    assert good > 0.7 and bad == 0.0


@pytest.mark.parametrize("through", [1, 3])
def test_several_keyframes_must_measure_through_a_point(through: int):
    cloud = torch.cat([points(*30 * [2.0]), points(1.0)])
    near = [wall(1.0, n) for n in range(2)]
    far = [wall(2.0, 2 + n) for n in range(through)]
    mask = FreeSpace().contradicted(cloud, far[-1], [*near, *far[:-1]])
    assert mask[-1].item() == (through == 3) and not mask[:-1].any()


def test_what_was_never_measured_is_removed_by_any_keyframe_that_measured_through_it():
    cloud = torch.cat([points(*30 * [2.0]), points(1.0, 2.5)])
    radii_m = torch.full((32,), 0.01)
    # At 0.5 of the distance, the confidence of one keyframe is a quarter: too little on its own.
    far = wall(6.0)
    once = Evidence.of(cloud, [DepthView.of(far)], whole_map=False)
    assert not once.contradicts().any()
    assert once.contradicts_in_map(radii_m).all()
    # Others measured a surface at 2 m, which is not in doubt.
    both = Evidence.of(cloud, [DepthView.of(far), DepthView.of(wall(2.0))], whole_map=False)
    mask = both.contradicts_in_map(radii_m)
    assert mask[30:].all() and not mask[:30].any()


def test_what_was_never_measured_must_not_be_a_blob_in_any_keyframe():
    evidence = Evidence.of(points(2.5, 2.5, 2.0), [DepthView.of(wall())], whole_map=False)
    radii_m = torch.tensor([0.05, 0.1, 0.1])
    mask = evidence.contradicts_in_map(radii_m)
    assert evidence.nearest_m.tolist() == [2.5, 2.5, 2.0]
    assert mask.tolist() == [False, True, False]


def test_seeds_in_space_that_others_saw_through_are_dropped_unless_they_are_many():
    others = [wall(2.0, n) for n in range(3)]
    few = torch.cat([points(*30 * [2.0]), points(1.0)])
    free_space = FreeSpace()
    assert free_space.seen_through(few, others).nonzero().tolist() == [[30]]
    assert not free_space.seen_through(points(1.0, 1.0, 2.0), others).any()


def test_images_of_depth_are_prepared_once_unless_a_keyframe_changes():
    views, keyframe = DepthViews(), wall(2.0)
    image = views.of(keyframe).image
    keyframe.T_map_camera = keyframe.T_map_camera.copy()
    keyframe.T_map_camera[0, 3] = 1.0
    moved = views.of(keyframe)
    assert moved.image is image and moved.T_camera_map[0, 3] == -1.0
    keyframe.hide(torch.ones(30, 40, dtype=torch.bool))
    assert not views.of(keyframe).image.empty_m.any() and image.empty_m.all()
    assert views.of(wall(3.0)).image is not views.of(keyframe).image


def test_a_ghost_of_one_keyframe_is_removed(room: MappedRoom, hidden_too):
    frames = list(room.frames[:4])
    ghost = frames[0].depth_m.copy()
    ghost[10:25, 10:25] *= 0.5
    frames[0] = replace(frames[0], depth_m=ghost)
    counts = []
    for use in (False, True):
        options = MapperOptions(final_iterations=1, free_space=use)
        mapper = MappedSubmap(options)
        for frame, pose in zip(frames, room.T_map_camera, strict=False):
            mapper.add_keyframe(Keyframe.from_frame(frame, pose))
        mapper.refine()
        truth = Keyframe.from_frame(room.frames[0], room.T_map_camera[0])
        evidence = Evidence.of(mapper.gaussians.means, [DepthView.of(truth)])
        counts.append(int((evidence.through > 0).sum()))
    assert counts[0] > 20 and counts[1] < 0.1 * counts[0]


def test_opacity_in_empty_space_is_measured_by_majority_and_by_any_frame():
    cloud = GaussianCloud.from_values(
        means=points(2.0, 1.0, 1.5),
        radii_m=torch.full((3,), 0.01),
        opacities=torch.tensor([0.5, 0.3, 0.2]),
        colours=torch.zeros(3, 3),
    )
    views = [DepthView.of(wall(2.0)), DepthView.of(wall(1.5)), DepthView.of(wall(1.5))]
    found = free_space_metrics(InMemoryScene(cloud), views)
    assert found["opacity_percent"] == pytest.approx(30.0)
    assert found["opacity_any_percent"] == pytest.approx(50.0)
    assert free_space_metrics(InMemoryScene(cloud), [])["opacity_percent"] is None


@pytest.mark.parametrize("whole_map", [True, False])
@pytest.mark.parametrize("name", available_instruction_sets())
def test_the_kernels_agree_with_torch(
    room: MappedRoom, name: str, whole_map: bool, monkeypatch: pytest.MonkeyPatch
):
    views = [
        DepthView.of(Keyframe.from_frame(frame, T))
        for frame, T in zip(room.frames[:5], room.T_map_camera, strict=False)
    ]
    corners = np.concatenate([view.box for view in views])
    low, high = corners.min(axis=0) - 0.5, corners.max(axis=0) + 0.5
    means = torch.from_numpy(np.random.default_rng(0).uniform(low, high, (5000, 3))).float()
    found = []
    for variant in (None, load_variant(name)):
        for module in (depth_views, free_space):
            monkeypatch.setattr(module, "kernels_for", lambda tensor, variant=variant: variant)
        empty = torch.stack([view.measures_through(means) for view in views])
        evidence = Evidence.of(means, views, whole_map)
        found.append((empty.float(), evidence.through, evidence.support, evidence.nearest_m))
    for expected, value in zip(*found, strict=True):
        assert expected.isfinite().any() and (expected != expected.reshape(-1)[0]).any()
        # Rounding may move a point on the border of a pixel into the next one.
        differs = ~torch.isclose(expected, value, rtol=1e-4, atol=1e-5)
        assert differs.float().mean() < 0.002


@pytest.mark.parametrize("name", available_instruction_sets())
@pytest.mark.parametrize("size", [(53, 37), (1, 20)])
def test_the_confidence_of_the_kernel_agrees_with_opencv(
    name: str, size: tuple[int, int], monkeypatch: pytest.MonkeyPatch
):
    width, height = size
    camera = Camera(fx=40.0, fy=45.0, cx=20.0, cy=15.0, width=width, height=height)
    generator = np.random.default_rng(0)
    depth_m = (2.0 + 3.0 * generator.random((height, width))).astype(np.float32)
    depth_m[height // 2 :] = 1.0 + 0.01 * np.arange(width, dtype=np.float32)
    depth_m[generator.random(depth_m.shape) < 0.1] = 0.0
    found = []
    for variant in (None, load_variant(name)):
        monkeypatch.setattr(depth_views, "kernels", lambda variant=variant: variant)
        found.append(depth_views.depth_confidence(depth_m, camera))
    assert ((found[0] == 0) == (depth_m == 0)).all() and np.unique(found[0]).size > 5
    assert np.allclose(*found, rtol=1e-4, atol=1e-5)


def test_nothing_hides_the_view_of_a_frame():
    """Frames between keyframes show that they are in empty space, too."""
    camera = Camera(fx=40.0, fy=40.0, cx=19.5, cy=14.5, width=40, height=30)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = [0.0, 1.0, -2.0]
    poses[1, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # looks back
    offsets = {
        "ahead": (0.01, 0.0, 0.1),
        "beside": (0.1, 0.0, 0.02),
        "behind": (0.0, 0.0, -0.1),
        "farther": (0.0, 0.0, 0.16),
    }
    hidden = {
        name: [bool(hides_view(torch.from_numpy((pose[:3, 3] + offset)[None]), camera, poses)[0])]
        for name, offset in offsets.items()
        for pose in poses[2:]
    }
    assert hidden == {"ahead": [True], "beside": [False], "behind": [False], "farther": [False]}
    assert hides_view(torch.tensor([[1.0, 0.0, -0.1]]), camera, poses).tolist() == [True]
    assert hides_view(torch.zeros(2, 3), camera, poses[1:]).tolist() == [False, False]
    assert hides_view(torch.zeros(0, 3), camera, poses).tolist() == []


def test_a_blob_before_a_frame_between_keyframes_is_removed(room: MappedRoom):
    mapper = MappedSubmap(MapperOptions(final_iterations=0, fill_holes=False))
    for frame, T in list(zip(room.frames, room.T_map_camera, strict=False))[:2]:
        mapper.add_keyframe(Keyframe.from_frame(frame, T))
    count = len(mapper.gaussians)
    # Turned to the left, to where no keyframe looks.
    T_between = room.T_map_camera[1].copy()
    T_between[:3, :3] = T_between[:3, :3] @ np.array([[0, 0, -1.0], [0, 1, 0], [1, 0, 0]])
    blob = torch.from_numpy(T_between[:3, 3] + 0.1 * T_between[:3, 2]).float()
    mapper.gaussians.means[0] = blob
    for poses, left in ((None, 1), (np.stack([*room.T_map_camera[:2], T_between]), 0)):
        mapper.refine(poses)
        assert int((mapper.gaussians.means == blob).all(dim=1).sum()) == left
    assert len(mapper.gaussians) > 0.9 * count


def test_what_no_keyframe_measured_is_no_blob_to_any_frame_of_the_path():
    # One on the far wall, one where nothing was measured, and one there that
    # a frame passes at a quarter of a metre.
    depth_m = np.full((30, 40), 4.0, np.float32)
    depth_m[:, 20:] = 0.0
    means = torch.tensor([[-0.5, 0.0, 4.0], [1.0, 0.5, 4.0], [1.0, -0.5, 4.0]])
    evidence = Evidence.of(means, [DepthView.of(wall(depth_m=depth_m))])
    radii_m = torch.full((3,), 0.03)
    assert not evidence.contradicts_in_map(radii_m).any()
    poses = np.stack([np.eye(4)] * 3)
    poses[0, :3, 3], poses[1, :3, 3] = (1.0, -0.5, 3.75), (-0.5, 0.0, 3.75)
    evidence.pass_by(means, CAMERA, poses)
    assert evidence.contradicts_in_map(radii_m).tolist() == [False, False, True]
    assert evidence.support.tolist() == [1, 0, 0]


def test_points_belong_to_the_pixel_with_the_nearest_centre():
    pixels = np.array([[5.4, 10.4], [5.6, 10.4], [5.4, 10.6], [-0.4, 29.4], [39.4, -0.4]])
    outside = np.array([[-0.6, 3.0], [39.6, 3.0], [3.0, -0.6], [3.0, 29.6]])
    rays = np.ones((9, 3))
    rays[:, :2] = (np.concatenate([pixels, outside]) - [CAMERA.cx, CAMERA.cy]) / 40.0
    # The last three are too near or behind the camera.
    means = np.concatenate([2.0 * rays, [[0.0, 0.0, z] for z in (0.04, -0.04, -2.0)]])
    chosen, flat, z_m = DepthView.of(wall()).pixels_of(torch.from_numpy(means).float())
    assert chosen.tolist() == [0, 1, 2, 3, 4]
    assert flat.tolist() == [row * 40 + column for column, row in np.rint(pixels).astype(int)]
    assert z_m.tolist() == [2.0] * 5


@pytest.mark.parametrize(("supporting", "contradicted"), [(2, True), (4, False)])
def test_support_counts_a_third_of_a_contradiction(supporting, contradicted, monkeypatch):
    views = [DepthView.of(wall(2.0))] * supporting + [DepthView.of(wall(2.9))]
    evidence = Evidence.of(points(2.0), views, whole_map=False)
    assert evidence.support.tolist() == [supporting]
    assert float(evidence.through) > 0.9
    monkeypatch.setattr(free_space, "_MIN_THROUGH", 0.5)
    assert evidence.contradicts().tolist() == [contradicted]
