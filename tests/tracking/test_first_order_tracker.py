"""The papers' tracker: its gradient, its loss, and the pose that it keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from mapped_submap import MappedSubmap
from tracked_room import (
    Room,
    assert_same_place,
    blind_frame,
    composited_frame,
    dead_sensor_frame,
    distance_mm,
    first_steps,
    frame_from_elsewhere,
    map_of_first_frame,
    opaque_map_of_first_frame,
    small_motion,
)

from toolkit.base.errors import SettingsError
from toolkit.base.exposure import IDENTITY
from toolkit.base.geometry import se3
from toolkit.base.keyframe import Keyframe
from toolkit.datasets.synthetic_rooms.vocabulary import CLASS_NAMES
from toolkit.semantics.codes import binary_code
from toolkit.semantics.taxonomy import Taxonomy
from toolkit.slam.mapping.options import MapperOptions
from toolkit.slam.tracking import first_order_tracker
from toolkit.slam.tracking.dense import DenseTracker
from toolkit.slam.tracking.factory import build_tracker
from toolkit.slam.tracking.first_order_tracker import FirstOrderTracker
from toolkit.slam.tracking.options import FirstOrderOptions, TrackingOptions
from toolkit.splatting.alignment.pose_adam import pose_gradient
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.tracking_loss import PRESETS, TrackingLoss, tracking_loss
from toolkit.splatting.rendering import backend

BOTH = pytest.mark.parametrize("preset", sorted(PRESETS))


@pytest.fixture(scope="module")
def room() -> Room:
    return first_steps()


@pytest.fixture(scope="module")
def gaussians() -> GaussianCloud:
    return map_of_first_frame()


@pytest.fixture(scope="module")
def opaque_map() -> GaussianCloud:
    return opaque_map_of_first_frame()


def loss_at(room: Room, gaussians: GaussianCloud, number: int, T_map_camera, preset: str) -> float:
    frame = room.frames[number]
    drawn = backend().forward(gaussians, frame.camera, se3.inverse(T_map_camera), None, None)
    rgb = torch.from_numpy(np.ascontiguousarray(frame.rgb.transpose(2, 0, 1)))
    depth_m = torch.from_numpy(frame.depth_m)
    return tracking_loss(drawn.images, rgb, depth_m, PRESETS[preset]).per_pixel


def test_pose_gradient_is_the_derivative_by_a_left_perturbation():
    generator = np.random.default_rng(0)
    T = se3.exp(generator.normal(size=6))
    weights = generator.normal(size=(3, 4))

    def value(xi: np.ndarray) -> float:
        return float((weights * (se3.exp(xi) @ T)[:3]).sum())

    step = 1e-6
    numerical = [(value(step * e) - value(-step * e)) / (2 * step) for e in np.eye(6)]
    assert np.allclose(pose_gradient(weights, T), numerical, atol=1e-8)


@BOTH
def test_pose_gradient_is_the_derivative_of_the_rendered_loss(room, opaque_map, preset):
    """Through the loss and the renderer, as the tracker chains them."""
    frame, weights = room.frames[1], replace(PRESETS[preset], min_silhouette=0.5)
    rgb = torch.from_numpy(np.ascontiguousarray(frame.rgb.transpose(2, 0, 1)))
    depth_m = torch.from_numpy(frame.depth_m)
    T_camera_map = se3.inverse(room.T_map_camera[1] @ small_motion(1, 0.02, 1.0))

    def loss_of(T: np.ndarray):
        drawn = backend().forward(opaque_map, frame.camera, T, None, None)
        return drawn, tracking_loss(drawn.images, rgb, depth_m, weights)

    # Far from the map's border: a pixel that enters the mask is no part of the derivative.
    thin = (loss_of(T_camera_map)[0].images[4] < 0.9).float()[None]
    near_border = torch.nn.functional.max_pool2d(thin, 9, stride=1, padding=4)[0] > 0
    depth_m = torch.where(near_border, torch.zeros_like(depth_m), depth_m)
    assert int((depth_m > 0).sum()) > 3000
    drawn, loss = loss_of(T_camera_map)
    by_matrix = drawn.backward(loss.gradient, colours=False).T_camera_map.numpy()
    gradient = pose_gradient(by_matrix, T_camera_map)
    step = 1e-4
    moves = [[se3.exp(s * step * e) @ T_camera_map for s in (1, -1)] for e in np.eye(6)]
    numerical = [(loss_of(a)[1].value - loss_of(b)[1].value) / (2 * step) for a, b in moves]
    assert np.linalg.norm(gradient - numerical) < 0.05 * np.linalg.norm(gradient)


@BOTH
def test_the_loss_falls(room, opaque_map, preset):
    tracker = FirstOrderTracker(FirstOrderOptions(preset))
    start = room.T_map_camera[1] @ small_motion(1, metres=0.02, degrees=1.0)
    result = tracker.locate(room.frames[1], opaque_map, start)
    before = loss_at(room, opaque_map, 1, start, preset)
    assert loss_at(room, opaque_map, 1, result.T_map_camera, preset) < 0.7 * before


@BOTH
def test_a_view_of_the_map_itself_is_found(room, opaque_map, preset):
    pose = small_motion(0, metres=0.01, degrees=0.5)
    frame = composited_frame(opaque_map, room.frames[1], pose)
    tracker = FirstOrderTracker(FirstOrderOptions(preset))
    tracker.first_pose(room.frames[0])
    result = tracker.track(frame, opaque_map)
    assert not result.lost
    assert_same_place(result.T_map_camera, pose, mm=2.0, deg=0.1)


def learn_at(monkeypatch, translation_m: float, rotation_rad: float) -> None:
    monkeypatch.setattr(first_order_tracker, "_TRANSLATION_RATE_M", translation_m)
    monkeypatch.setattr(first_order_tracker, "_ROTATION_RATE_RAD", rotation_rad)


@BOTH
def test_the_best_pose_is_kept(room, opaque_map, preset, monkeypatch):
    """Steps far too large end anywhere; what is returned is the best that was drawn."""
    learn_at(monkeypatch, 0.05, 0.05)
    tracker = FirstOrderTracker(FirstOrderOptions(preset, iterations=6))
    pose = room.T_map_camera[1]
    result = tracker.locate(room.frames[1], opaque_map, pose)
    assert np.allclose(result.T_map_camera, pose, atol=1e-12), "no step improved on the truth"
    assert result.converged


@BOTH
def test_the_last_step_counts_too(room, opaque_map, preset, monkeypatch):
    """One step is judged by the render after it, not by the one before."""
    start = room.T_map_camera[1] @ small_motion(1, metres=0.03, degrees=1.0)
    learn_at(monkeypatch, 0.0002, 0.0001)
    tracker = FirstOrderTracker(FirstOrderOptions(preset, iterations=1))
    result = tracker.locate(room.frames[1], opaque_map, start)
    assert (result.renders, result.iterations) == (2, 1)
    assert distance_mm(result.T_map_camera, start) == pytest.approx(0.2 * np.sqrt(3), rel=0.1)
    assert loss_at(room, opaque_map, 1, result.T_map_camera, preset) < loss_at(
        room, opaque_map, 1, start, preset
    )


@pytest.mark.parametrize("make", [blind_frame, dead_sensor_frame, frame_from_elsewhere])
def test_frames_that_cannot_be_placed_are_lost(room, opaque_map, make):
    tracker = FirstOrderTracker(FirstOrderOptions(iterations=10))
    tracker.first_pose(room.frames[0])
    result = tracker.track(make(room.frames[1]), opaque_map)
    assert result.lost and result.reason
    assert np.isfinite(result.T_map_camera).all()


def test_an_empty_map_costs_one_render(room):
    result = FirstOrderTracker().locate(room.frames[1], GaussianCloud.empty(), np.eye(4))
    assert result.lost and result.renders == 1


def test_judgement_agrees_with_the_dense_tracker(room):
    pose = room.T_map_camera[1]
    # The loss holds pixels against each other as they are drawn, so the map is fitted like that.
    mapper = MappedSubmap(MapperOptions(centred=False))
    mapper.add_keyframe(Keyframe.from_frame(room.frames[0], room.T_map_camera[0]))
    gaussians = mapper.gaussians
    first = FirstOrderTracker(FirstOrderOptions(iterations=1)).locate(
        room.frames[1], gaussians, pose
    )
    dense = DenseTracker().locate(room.frames[1], gaussians, pose)
    assert first.visible_fraction == pytest.approx(dense.visible_fraction, rel=0.1)
    # One step of Adam has left the true pose: measured 4.3e-4 m against 1.4e-4 m.
    assert 0.25 < first.depth_residual_m / dense.depth_residual_m < 4.0
    ratio = np.diag(first.information) / np.diag(dense.information)
    assert ((ratio > 0.05) & (ratio < 20.0)).all()


def test_frames_are_judged_by_the_colour_that_the_loss_compares(room, gaussians, monkeypatch):
    """As composited: divided by the silhouette, a perfect frame would seem too dark."""
    pose = small_motion(0, metres=0.01, degrees=0.5)
    frame = composited_frame(gaussians, room.frames[1], pose)
    learn_at(monkeypatch, 1e-9, 1e-9)
    result = FirstOrderTracker(FirstOrderOptions(iterations=1)).locate(frame, gaussians, pose)
    assert result.intensity_residual < 0.003
    assert not result.lost


def test_a_restored_tracker_goes_on_with_the_same_bits(room, opaque_map):
    tracker = FirstOrderTracker(FirstOrderOptions(iterations=4))
    tracker.first_pose(room.frames[0])
    tracker.track(room.frames[1], opaque_map)
    other = FirstOrderTracker(FirstOrderOptions(iterations=4))
    other.restore({name: array.copy() for name, array in tracker.state().items()})
    here, there = (t.track(room.frames[2], opaque_map) for t in (tracker, other))
    assert here.T_map_camera.tobytes() == there.T_map_camera.tobytes()


def test_unknown_presets_are_refused():
    with pytest.raises(SettingsError, match="hier-slam"):
        FirstOrderTracker(FirstOrderOptions(preset="splatam"))


def test_the_factory_builds_what_the_settings_name():
    values = FirstOrderOptions(preset="gausem", iterations=7)
    tracker = build_tracker(TrackingOptions(kind="first-order", first_order=values))
    assert isinstance(tracker, FirstOrderTracker)
    assert tracker.options.preset == "gausem" and tracker.options.iterations == 7
    assert isinstance(build_tracker(TrackingOptions()), DenseTracker)


class TestLoss:
    """The loss of H-22 and G-2 by itself."""

    def images(self, height: int = 6, width: int = 8) -> torch.Tensor:
        images = torch.rand(6, height, width, generator=torch.Generator().manual_seed(2))
        images[4] = 0.995
        images[4, :2] = 0.9
        return images

    def frame(self, height: int = 6, width: int = 8) -> tuple[torch.Tensor, torch.Tensor]:
        generator = torch.Generator().manual_seed(3)
        rgb = torch.rand(3, height, width, generator=generator)
        depth = torch.rand(height, width, generator=generator) + 0.5
        depth[:, :3] = 0.0
        return rgb, depth

    @BOTH
    def test_gradient_is_the_derivative(self, preset):
        rgb, depth = self.frame()
        images = self.images().double()
        loss = tracking_loss(images, rgb.double(), depth.double(), PRESETS[preset])
        step = 1e-7
        for index in [(0, 3, 4), (2, 5, 7), (3, 4, 5), (4, 2, 3), (5, 3, 3), (0, 0, 5), (3, 4, 0)]:
            ahead = images.clone()
            ahead[index] += step
            moved = tracking_loss(ahead, rgb.double(), depth.double(), PRESETS[preset])
            numerical = (moved.value - loss.value) / step
            assert float(loss.gradient[index]) == pytest.approx(numerical, abs=1e-5)

    @BOTH
    def test_thin_and_unmeasured_pixels_do_not_count(self, preset):
        rgb, depth = self.frame()
        images = self.images()
        loss = tracking_loss(images, rgb, depth, PRESETS[preset])
        assert loss.pixels == 4 * 5
        assert not loss.gradient[:, :2].any() and not loss.gradient[:, :, :3].any()
        images[:5, :2] = torch.where(torch.arange(5)[:, None, None] == 4, 0.9, 7.0)
        images[:4, :, :3] = float("nan")
        again = tracking_loss(images, rgb, depth, PRESETS[preset])
        assert again.value == loss.value

    def test_weights_are_the_papers(self):
        """H-22: depth + 0.5 colour; G-2: colour + 0.5 depth; both are sums."""
        images = torch.full((5, 4, 4), 1.0)
        rgb, depth = torch.full((3, 4, 4), 0.9), torch.full((4, 4), 1.2)
        colour, range_m = 0.1, 0.2
        hier = tracking_loss(images, rgb, depth, PRESETS["hier-slam"])
        assert hier.value == pytest.approx(16 * (range_m + 0.5 * 3 * colour), rel=1e-5)
        gausem = tracking_loss(images, rgb, depth, PRESETS["gausem"])
        assert gausem.value == pytest.approx(16 * (3 * colour + 0.5 * range_m), rel=1e-5)

    def test_a_sum_over_fewer_pixels_is_not_a_better_pose(self):
        images = self.images()
        rgb, depth = self.frame()
        half = depth.clone()
        half[3:] = 0.0
        preset = PRESETS["hier-slam"]
        whole, part = (tracking_loss(images, rgb, d, preset) for d in (depth, half))
        assert part.value < 0.5 * whole.value
        assert part.per_pixel == pytest.approx(whole.per_pixel, rel=0.5)

    def test_nothing_to_compare_is_infinitely_bad(self):
        rgb, depth = self.frame()
        loss = tracking_loss(self.images(), rgb, torch.zeros_like(depth), PRESETS["gausem"])
        assert loss.per_pixel == float("inf") and not loss.gradient.any()


def test_frames_keep_their_exposure(room, opaque_map):
    """The papers estimate none: it is reported as the identity."""
    darker = replace(room.frames[1], rgb=room.frames[1].rgb * np.float32(0.9))
    result = FirstOrderTracker(FirstOrderOptions(iterations=2)).locate(
        darker, opaque_map, np.eye(4)
    )
    assert result.exposure == IDENTITY


CLASSES = Taxonomy.flat(CLASS_NAMES)


def labelled_map(room: Room, gaussians: GaussianCloud) -> GaussianCloud:
    """The map with each Gaussian labelled by the pixel of the first frame that it falls on."""
    frame = room.frames[0]
    uv = np.rint(frame.camera.project(gaussians.means.double().numpy())).astype(int)
    u = uv[:, 0].clip(0, frame.camera.width - 1)
    v = uv[:, 1].clip(0, frame.camera.height - 1)
    ids = torch.from_numpy(frame.labels[v, u].astype(np.int64))
    return replace(gaussians, features=binary_code(CLASSES).start_values.index_select(0, ids))


@BOTH
def test_semantic_term_has_the_gradient_of_its_loss(room, opaque_map, preset, monkeypatch):
    """Through code, loss and renderer to the pose, features alone being compared."""
    monkeypatch.setitem(PRESETS, preset, replace(PRESETS[preset], min_silhouette=0.5))
    gaussians = labelled_map(room, opaque_map)
    options = FirstOrderOptions(preset, semantic=0.5)
    tracker = FirstOrderTracker(options, code=binary_code(CLASSES))
    frame, start = room.frames[1], small_motion(3, 0.01, 0.3)
    labels = torch.from_numpy(frame.labels)

    def semantic_loss(xi: np.ndarray, backward: bool = False):
        T = se3.exp(xi) @ start
        drawn = backend().forward(gaussians, frame.camera, T, gaussians.features, None)
        nothing = TrackingLoss(0.0, 0.0, torch.zeros_like(drawn.images), labels.numel())
        loss = tracker._with_semantics(nothing, drawn.images, labels)
        if not backward:
            return loss.value
        return pose_gradient(drawn.backward(loss.gradient).T_camera_map.numpy(), T)

    step = 2e-4
    numerical = np.array(
        [(semantic_loss(step * e) - semantic_loss(-step * e)) / (2 * step) for e in np.eye(6)]
    )
    analytic = semantic_loss(np.zeros(6), backward=True)
    assert np.allclose(analytic, numerical, rtol=0.05, atol=0.03 * abs(numerical).max())


def test_semantic_term_is_used_only_where_frames_have_labels(room, opaque_map):
    gaussians = labelled_map(room, opaque_map)
    options = FirstOrderOptions(iterations=5, semantic=0.5)
    tracker = FirstOrderTracker(options, code=binary_code(CLASSES))
    plain = FirstOrderTracker(replace(options, semantic=0.0), code=binary_code(CLASSES))
    assert tracker.wants_labels and not plain.wants_labels
    frame, start = room.frames[1], small_motion(3, 0.01, 0.3)
    found = tracker.locate(frame, gaussians, start).T_map_camera
    bare = tracker.locate(replace(frame, labels=None), gaussians, start).T_map_camera
    expected = plain.locate(frame, gaussians, start).T_map_camera
    assert np.array_equal(bare, expected)
    assert not np.array_equal(found, expected)


@pytest.mark.parametrize(("preset", "wants_labels"), [("hier-slam", False), ("gausem", True)])
def test_preset_decides_whether_semantics_are_tracked(preset, wants_labels):
    """G-2 has a semantic term of weight 0.5, H-22 has none; an explicit weight overrides both."""
    code = binary_code(CLASSES)
    settings = TrackingOptions(kind="first-order", first_order=FirstOrderOptions(preset=preset))
    assert build_tracker(settings, code=code).wants_labels is wants_labels
    assert not build_tracker(settings, code=None).wants_labels
    assert FirstOrderTracker(FirstOrderOptions(preset, semantic=0.5), code=code).wants_labels
    assert not FirstOrderTracker(FirstOrderOptions(preset, semantic=0.0), code=code).wants_labels


def test_gausem_preset_tracks_semantics_with_weight_one_half(room, opaque_map):
    gaussians = labelled_map(room, opaque_map)
    frame, start = room.frames[1], small_motion(3, 0.01, 0.3)

    def located(semantic: float | None) -> np.ndarray:
        options = FirstOrderOptions("gausem", iterations=3, semantic=semantic)
        tracker = FirstOrderTracker(options, code=binary_code(CLASSES))
        return tracker.locate(frame, gaussians, start).T_map_camera

    assert np.array_equal(located(None), located(0.5))
    assert not np.array_equal(located(None), located(0.0))
