"""Gaussians at pixels without a measured depth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap

from tests.mapping.conftest import MappedRoom
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.base.keyframe import Keyframe
from toolkit.slam.mapping.depth_views import DepthView
from toolkit.slam.mapping.hole_filling import (
    _nearest_labels,
    _outside_free_space,
    fill_all_holes,
    fill_holes,
    inferred_depth,
)
from toolkit.slam.mapping.options import MapperOptions
from toolkit.splatting.gaussians.cloud import GaussianCloud

OPTIONS = MapperOptions(first_iterations=5, iterations=2, final_iterations=2)
HOLE = np.s_[20:40, 30:55]


def without_depth(frame: Frame, hole: tuple[slice, slice] = HOLE) -> Frame:
    depth_m = frame.depth_m.copy()
    depth_m[hole] = 0.0
    return replace(frame, depth_m=depth_m)


def mapped(
    frames: list[Frame], poses: np.ndarray, options: MapperOptions = OPTIONS
) -> MappedSubmap:
    mapper = MappedSubmap(options)
    for frame, pose in zip(frames, poses, strict=True):
        mapper.add_keyframe(Keyframe.from_frame(frame, pose))
    mapper.refine()
    return mapper


def colour_error(mapper: MappedSubmap, keyframe: Keyframe) -> float:
    colour = mapper.view(keyframe).output.colour.permute(2, 0, 1)
    error = (colour - keyframe.target_rgb()).abs().mean(dim=0)
    return float(error[HOLE].mean())


def test_depth_of_a_fronto_parallel_surface_is_continued():
    depth_m = np.full((30, 40), 2.0, np.float32)
    depth_m[5:20, 10:33] = 0.0
    depth_m[:, 36:] = 0.0
    np.testing.assert_allclose(inferred_depth(depth_m), 2.0, rtol=1e-5)


def test_measured_depth_does_not_change_and_missing_depth_stays_in_its_range():
    depth_m = np.random.default_rng(0).uniform(1.0, 3.0, (31, 47)).astype(np.float32)
    depth_m[8:20, 11:29] = 0.0
    known, filled = depth_m > 0, inferred_depth(depth_m)
    np.testing.assert_array_equal(filled[known], depth_m[known])
    assert filled.min() >= 1.0 and filled.max() <= 3.0


def test_a_hole_beside_a_depth_edge_belongs_to_the_far_surface():
    depth_m = np.full((40, 160), 3.0, np.float32)
    depth_m[:, :80] = 1.0
    depth_m[:, 78:86] = 0.0
    assert inferred_depth(depth_m)[20, 78:86].min() > 2.5


def test_a_hole_inside_a_surface_ignores_a_far_one_that_does_not_touch_it():
    """As of a dark screen on a wall with an open door, or beside a mirror."""
    depth_m = np.full((60, 160), 2.0, np.float32)
    depth_m[:, 10:45] = 6.0
    depth_m[15:45, 60:120] = 0.0
    np.testing.assert_allclose(inferred_depth(depth_m)[15:45, 60:120], 2.0, rtol=0.1)


def test_refinement_fills_a_hole_that_no_keyframe_measured(room: MappedRoom):
    frame, pose = without_depth(room.frames[0]), room.T_map_camera[:1]
    empty = mapped([frame], pose, replace(OPTIONS, fill_holes=False))
    filled = mapped([frame], pose)
    assert colour_error(empty, empty.keyframes[0]) > 0.08
    assert colour_error(filled, filled.keyframes[0]) < 0.05
    assert len(filled.gaussians) > len(empty.gaussians)


def test_a_hole_that_another_keyframe_measured_stays_as_measured(room: MappedRoom):
    frames = [without_depth(room.frames[0]), room.frames[1]]
    poses = room.T_map_camera[:2]
    maps = [mapped(frames, poses, replace(OPTIONS, fill_holes=fill)) for fill in (False, True)]
    added = len(maps[1].gaussians) - len(maps[0].gaussians)
    # The second view sees everything but a border of the hole in the first.
    assert added < 0.1 * 20 * 25


def test_complete_depth_needs_no_filling(room: MappedRoom):
    frames, poses = room.frames[:2], room.T_map_camera[:2]
    maps = [mapped(frames, poses, replace(OPTIONS, fill_holes=fill)) for fill in (False, True)]
    assert torch.equal(maps[0].gaussians.means, maps[1].gaussians.means)


def test_points_that_another_keyframe_measured_through_are_moved_away(room: MappedRoom):
    # The surroundings of a hole in one view are nearer than what the other view measured in it.
    truth = room.frames[0].depth_m[HOLE].ravel()
    inferred_m = 0.6 * float(truth.max())
    near = np.full_like(room.frames[0].depth_m, inferred_m)
    near[HOLE] = 0.0
    frames = [replace(room.frames[0], depth_m=near), room.frames[0]]
    poses = np.stack([room.T_map_camera[0]] * 2)
    mapper = MappedSubmap(OPTIONS)
    keyframes = [Keyframe.from_frame(f, T) for f, T in zip(frames, poses, strict=True)]
    rows, columns = np.mgrid[HOLE]
    rays = keyframes[0].camera.rays()[rows.ravel(), columns.ravel()]
    points = rays * inferred_m
    through = DepthView.of(keyframes[1]).measures_through(torch.from_numpy(points).float()).numpy()
    np.testing.assert_array_equal(through, truth - np.maximum(0.05, 0.03 * truth) > inferred_m)
    assert through.any()
    mapper.add_keyframe(keyframes[0])
    mapper.submap.keyframes.append(keyframes[1])
    before = len(mapper.gaussians)
    fill_all_holes(mapper.submap, mapper.mapper.view, mapper.mapper.densification)
    added = mapper.gaussians.means[before:]
    assert len(added)
    assert not DepthView.of(keyframes[1]).measures_through(added).any()


def test_points_measured_through_at_every_factor_are_behind_everything(room: MappedRoom):
    """As the sky beside a near roof: the view stays filled, however far away the rest is."""
    near = np.full_like(room.frames[0].depth_m, 0.5)
    near[HOLE] = 0.0
    far = np.full_like(near, 40.0)
    pose = room.T_map_camera[0]
    frames = [replace(room.frames[0], depth_m=near), replace(room.frames[0], depth_m=far)]
    keyframes = [Keyframe.from_frame(frame, pose) for frame in frames]
    mapper = MappedSubmap(OPTIONS)
    mapper.add_keyframe(keyframes[0])
    before = len(mapper.gaussians)
    views = [DepthView.of(keyframes[1])]
    count = fill_holes(
        mapper.submap, keyframes[0], mapper.view(keyframes[0]), mapper.mapper.densification, views
    )
    added = mapper.gaussians.means[before:]
    assert count == len(added) > 0
    depth_m = (added - torch.tensor(pose[:3, 3])) @ torch.tensor(pose[:3, 2])
    assert float(depth_m.min()) > 40.0
    silhouette = mapper.view(keyframes[0]).output.silhouette[HOLE]
    assert float(silhouette.mean()) > 0.9


def test_every_keyframe_counts_however_many_there_are(room: MappedRoom):
    # One of 40 keyframes measured what is behind the hole; the others face away.
    truth, pose = room.frames[0].depth_m[HOLE], room.T_map_camera[0]
    near = np.full_like(room.frames[0].depth_m, 0.6 * float(truth.min()))
    near[HOLE] = 0.0
    away = pose @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, np.pi, 0.0]))
    frames = [replace(room.frames[0], depth_m=near), *40 * [room.frames[0]]]
    poses = [pose, *20 * [away], pose, *19 * [away]]
    keyframes = [Keyframe.from_frame(f, T) for f, T in zip(frames, poses, strict=True)]
    mapper = MappedSubmap(OPTIONS)
    mapper.add_keyframe(keyframes[0])
    before = len(mapper.gaussians)
    views = [DepthView.of(keyframe) for keyframe in keyframes[1:]]
    view = mapper.view(keyframes[0])
    fill_holes(mapper.submap, keyframes[0], view, mapper.mapper.densification, views)
    added = mapper.gaussians.means[before:]
    assert len(added) and not views[20].measures_through(added).any()


@pytest.mark.parametrize("labelled", [True, False])
def test_filled_pixels_have_the_nearest_label(labelled: bool):
    labels = np.zeros((20, 30), np.int32)
    if labelled:
        labels[:, :5], labels[:, 25:] = 3, 7
    filled = _nearest_labels(labels)
    assert np.array_equal(np.unique(filled), [3, 7] if labelled else [0])
    if labelled:
        assert (filled[:, :14] == 3).all() and (filled[:, 16:] == 7).all()


@pytest.mark.parametrize("shape", [(64, 3), (3, 64), (1, 9), (9, 1)])
def test_depth_is_continued_through_narrow_images(shape: tuple[int, int]):
    depth_m = np.zeros(shape, np.float32)
    depth_m[0, 0] = 2.0
    np.testing.assert_allclose(inferred_depth(depth_m), 2.0, rtol=1e-5)


def test_contradicted_seeds_move_along_their_rays():
    camera = Camera(40.0, 40.0, 19.5, 14.5, 40, 30)
    pose = se3.exp(np.array([3.0, -2.0, 1.5, 0.3, -0.5, 0.2]))

    def seen(depth_m: float) -> Keyframe:
        image = np.full((30, 40), depth_m, np.float32)
        return Keyframe.from_frame(
            Frame(0, 0.0, np.zeros((30, 40, 3), np.float32), image, camera), pose
        )

    rays = camera.rays()[5:25:5, 5:35:5].reshape(-1, 3)
    means = torch.from_numpy(se3.transform_points(pose, rays)).float()
    seeds = GaussianCloud.from_values(
        means,
        torch.full((len(rays),), 0.02),
        torch.full((len(rays),), 0.9),
        torch.zeros(len(rays), 3),
    )
    for measured_m in (2.0, 40.0):  # 40 m is behind the last of the factors
        moved = _outside_free_space(seeds, seen(1.0), [DepthView.of(seen(measured_m))])
        points = se3.transform_points(se3.inverse(pose), moved.means.double().numpy())
        depth_m = points[:, 2]
        assert len(moved) == len(seeds)
        np.testing.assert_allclose(points / depth_m[:, None], rays, atol=1e-5)
        assert (depth_m > 0.95 * measured_m).all() and (depth_m < 1.6 * measured_m).all()
        np.testing.assert_allclose(moved.radii_m.numpy(), 0.02 * depth_m, rtol=1e-4)
