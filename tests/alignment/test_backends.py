"""The C++ kernels of alignment against numpy, and both against their definitions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from tracked_room import Room

from toolkit.base.exposure import IDENTITY, Exposure
from toolkit.base.geometry import se3
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.alignment import backend
from toolkit.splatting.alignment.backend import align, linearise
from toolkit.splatting.alignment.data import (
    Alignment,
    FrameLevel,
    GaussNewtonOptions,
    LevelProblem,
    Linearisation,
    ModelLevel,
    ResidualScales,
)
from toolkit.splatting.alignment.levels import (
    halved,
    intensity_of,
    model_level,
    pyramid,
    view_level,
)
from toolkit.splatting.rendering import SurfaceView

SCALES = ResidualScales(intensity=0.03, depth_m=0.005)
LIGHT = replace(SCALES, photometric_weight=0.3)
WIDE = ResidualScales(intensity=1e3, depth_m=1e3)  # so wide that every residual has the same weight


@pytest.fixture(autouse=True)
def restored_threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch):
    """Choose the compiled kernels, or numpy with None."""

    def choose(module: ModuleType | None) -> None:
        monkeypatch.setattr(backend, "kernels_for", lambda tensor: module)

    return choose


def level_of(room: Room, number: int, width: int = 95, height: int = 71) -> FrameLevel:
    """A frame with holes, cut to a size that no vector width divides."""
    frame = room.frames[number]
    depth = frame.depth_m[:height, :width].copy()
    holes = np.random.default_rng(number).random(depth.shape) < 0.03
    depth[holes] = 0.0
    camera = frame.camera.cropped(0, 0, width, height)
    rgb = np.ascontiguousarray(frame.rgb[:height, :width])
    return FrameLevel(camera, intensity_of(rgb), torch.from_numpy(depth))


def surface_view(images: torch.Tensor, camera: Camera) -> SurfaceView:
    """A drawn view whose surface is the mean depth, with colours where they are drawn."""
    return SurfaceView(SimpleNamespace(images=images), images[3] / images[4], camera, np.eye(4))


def assert_close(actual: torch.Tensor, expected: torch.Tensor, few: int = 0) -> None:
    """Equal to single precision but for a few pixels at the thresholds."""
    wrong = ~torch.isclose(actual, expected, rtol=1e-4, atol=1e-5)
    assert int(wrong.any(dim=-1).sum()) <= few


def assert_same_sums(actual: Linearisation, expected: Linearisation, tolerance: float) -> None:
    scale = np.sqrt(np.outer(np.diag(expected.H), np.diag(expected.H)))
    assert np.all(abs(actual.H - expected.H) <= tolerance * scale + 1e-12)
    pixels = expected.intensity_pixels + expected.depth_pixels
    # Each residual is about one scale: a sum of n of them is held to n, not to its own size.
    reach = np.sqrt(np.diag(expected.H) * pixels)
    assert np.all(abs(actual.g - expected.g) <= tolerance * reach + 1e-12)
    for name in ("intensity_pixels", "depth_pixels", "frame_pixels"):
        assert getattr(actual, name) == pytest.approx(getattr(expected, name), abs=3)
    for name in ("intensity_variance", "depth_variance"):
        assert getattr(actual, name) == pytest.approx(getattr(expected, name), rel=3e-3)


class TestAgainstNumpy:
    """Every compiled instruction set agrees with numpy."""

    def test_sums(self, room, module, use):
        frame, view = level_of(room, 1), level_of(room, 0)
        pose = se3.inverse(room.T_map_camera[0]) @ room.T_map_camera[1]
        pose = se3.exp(np.array([0.004, -0.003, 0.005, 0.002, -0.003, 0.004])) @ pose
        use(None)
        model = model_level(view)
        expected = linearise(LevelProblem(model, frame, pose, LIGHT, Exposure(1.1, -0.02), 0.05))
        assert expected.depth_pixels > 1000 and expected.intensity_pixels > 1000
        use(module)
        actual = linearise(LevelProblem(model, frame, pose, LIGHT, Exposure(1.1, -0.02), 0.05))
        assert_same_sums(actual, expected, 2e-3)

    def test_halving(self, room, module, use):
        level = level_of(room, 0)
        use(None)
        expected = halved(level)
        use(module)
        actual = halved(level)
        assert actual.camera == expected.camera == level.camera.halved()
        assert_close(actual.intensity[..., None], expected.intensity[..., None])
        assert_close(actual.depth_m[..., None], expected.depth_m[..., None], few=2)

    def test_views(self, module, use):
        images = torch.rand(5, 33, 45, generator=torch.Generator().manual_seed(0))
        drawn = surface_view(images, Camera(40.0, 41.0, 20.0, 17.0, 45, 33))
        use(None)
        expected = view_level(drawn, 0.6)
        use(module)
        actual = view_level(drawn, 0.6)
        assert_close(actual.intensity[..., None], expected.intensity[..., None])
        assert_close(actual.depth_m[..., None], expected.depth_m[..., None])

    def test_derivatives_and_planes(self, room, module, use):
        level = level_of(room, 0)
        use(None)
        expected = model_level(level)
        use(module)
        actual = model_level(level)
        assert_close(actual.texture, expected.texture)
        usable = (expected.surface != 0).any(dim=-1)
        assert int(usable.sum()) > 1000
        assert_close(actual.surface, expected.surface, few=5)

    @pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 3), (17, 1), (1, 18)])
    def test_images_of_a_few_pixels(self, room, module, use, size):
        level = level_of(room, 0, *size)
        pose = se3.exp(np.full(6, 0.01))
        results = []
        for chosen in (None, module):
            use(chosen)
            model = model_level(level)
            half = halved(level)
            results.append(
                (half, linearise(LevelProblem(model, level, pose, SCALES, IDENTITY, 0.1)))
            )
        (half, expected), (native_half, actual) = results
        assert torch.allclose(half.intensity, native_half.intensity, atol=1e-6)
        assert torch.allclose(half.depth_m, native_half.depth_m, atol=1e-5)
        assert actual.frame_pixels == expected.frame_pixels
        assert np.allclose(actual.H, expected.H, rtol=1e-3, atol=1e-6)


class TestGaussNewton:
    """Every compiled instruction set takes the steps of the Python reference."""

    OPTIONS = GaussNewtonOptions(
        iterations=60,
        max_distance=0.1,
        photometric_weight=0.5,
        exposure=Exposure(1.02, -0.01),
        min_pixels=100,
        min_translation_m=1e-4,
        min_rotation_rad=1e-4,
    )

    def both(
        self, room: Room, module: ModuleType, use, options: GaussNewtonOptions, levels: int = 3
    ) -> tuple[Alignment, Alignment]:
        """Estimates of numpy and of the kernels, from the same start."""
        frames, views = (pyramid(level_of(room, n), levels) for n in (1, 0))
        off = se3.exp(np.array([0.01, -0.008, 0.012, 0.004, -0.006, 0.005]))
        true = se3.inverse(room.T_map_camera[0]) @ room.T_map_camera[1]
        start = Alignment(off @ true, SCALES, Exposure(1.05, 0.0), iterations=3)
        estimates = []
        for chosen in (None, module):
            use(chosen)
            models = [model_level(view) for view in views]
            estimates.append(align(models, frames, start, options))
        return estimates[0], estimates[1]

    @pytest.mark.parametrize("exposure", [OPTIONS.exposure, None], ids=["adjusted", "fixed"])
    def test_same_estimate(self, room, module, use, exposure):
        options = replace(self.OPTIONS, exposure=exposure)
        expected, actual = self.both(room, module, use, options)
        assert expected.converged and actual.converged
        assert expected.iterations - 3 > 5 and abs(actual.iterations - expected.iterations) <= 2
        np.testing.assert_allclose(actual.T_view_camera, expected.T_view_camera, atol=2e-5)
        assert actual.exposure.gain == pytest.approx(expected.exposure.gain, abs=1e-4)
        assert (actual.exposure.gain == 1.05) == (exposure is None)
        assert actual.scales.intensity == pytest.approx(expected.scales.intensity, rel=1e-2)
        assert actual.scales.depth_m == pytest.approx(expected.scales.depth_m, rel=1e-2)
        assert actual.last is not None and expected.last is not None
        assert_same_sums(actual.last, expected.last, 1e-2)
        R = actual.T_view_camera[:3, :3]
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)

    def test_one_step(self, room, module, use):
        """Steps are the same before rounding can move a pixel over a threshold."""
        options = replace(self.OPTIONS, iterations=1)
        expected, actual = self.both(room, module, use, options, levels=1)
        assert actual.iterations == expected.iterations == 4
        assert not actual.converged and not expected.converged
        np.testing.assert_allclose(actual.T_view_camera, expected.T_view_camera, atol=2e-6)

    def test_too_few_pixels_end_it_before_a_step(self, room, module, use):
        options = replace(self.OPTIONS, min_pixels=10**6)
        expected, actual = self.both(room, module, use, options)
        for estimate in (expected, actual):
            assert estimate.iterations == 4 and not estimate.converged
        np.testing.assert_array_equal(actual.T_view_camera, expected.T_view_camera)

    def test_a_level_without_iterations_keeps_the_start(self, room, module, use):
        expected, actual = self.both(room, module, use, replace(self.OPTIONS, iterations=0))
        assert actual.last is None and expected.last is None
        np.testing.assert_array_equal(actual.T_view_camera, expected.T_view_camera)

    def test_singular_equations_end_it(self, module, use):
        """A plain wall that the camera faces leaves three directions open."""
        camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
        level = FrameLevel(camera, torch.full((48, 64), 0.5), torch.full((48, 64), 2.0))
        start = Alignment(np.eye(4), SCALES)
        for chosen in (None, module):
            use(chosen)
            found = align([model_level(level)], [level], start, self.OPTIONS)
            assert not found.converged
            np.testing.assert_array_equal(found.T_view_camera, np.eye(4))


def test_the_number_of_threads_does_not_change_a_bit(room, module, use):
    use(module)
    frame = torch.nn.functional.interpolate(
        torch.stack([level_of(room, 1).intensity, level_of(room, 1).depth_m])[None],
        size=(240, 320),
    )[0]
    camera = Camera(250.0, 251.0, 160.0, 119.0, 320, 240)
    level = FrameLevel(camera, frame[0].contiguous(), frame[1].contiguous())
    pose = se3.exp(np.array([0.01, 0.0, -0.01, 0.003, 0.004, 0.0]))

    def everything(threads: int) -> list[bytes]:
        torch.set_num_threads(threads)
        model = model_level(level)
        half = halved(level)
        linear = linearise(LevelProblem(model, level, pose, SCALES, IDENTITY, 0.05))
        images = (model.texture, model.surface, half.intensity, half.depth_m)
        return [linear.H.tobytes(), linear.g.tobytes(), *(i.numpy().tobytes() for i in images)]

    assert everything(1) == everything(2) == everything(2)


def wall(camera: Camera, offset_m: float = 0.0) -> FrameLevel:
    """A slanted wall whose brightness changes linearly over the image."""
    rays = camera.rays()
    depth = (2.0 + offset_m) / (rays @ np.array([0.2, -0.1, 1.0]))
    y, x = np.mgrid[: camera.height, : camera.width]
    intensity = 0.3 + 0.004 * x + 0.003 * y
    return FrameLevel(
        camera,
        torch.from_numpy(intensity.astype(np.float32)),
        torch.from_numpy(depth.astype(np.float32)),
    )


CAMERA = Camera(60.0, 62.0, 31.0, 23.0, 64, 48)
EXPOSURE = Exposure(1.05, -0.01)


def total(linear: Linearisation) -> float:
    """The weighted sum of squares that the normal equations belong to."""
    squares = linear.intensity_variance * linear.intensity_pixels
    return squares + linear.depth_variance * linear.depth_pixels


@pytest.mark.parametrize("parameter", range(8))
def test_gradient_is_the_derivative_of_the_cost(use, parameter):
    """Both kinds of residual, pose and exposure, by central differences."""
    use(None)
    model, frame = model_level(wall(CAMERA)), wall(CAMERA, offset_m=0.01)
    # Only the middle counts, so that no step carries a pixel over the image's border.
    inner = torch.zeros_like(frame.depth_m)
    inner[6:-6, 6:-6] = frame.depth_m[6:-6, 6:-6]
    frame = FrameLevel(CAMERA, frame.intensity, inner)
    scales = ResidualScales(intensity=10.0, depth_m=1.0)
    base = se3.exp(np.array([0.003, 0.002, 0.0, 0.001, -0.002, 0.003]))

    def at(step: float) -> Linearisation:
        move = np.zeros(8)
        move[parameter] = step
        exposure = Exposure(EXPOSURE.gain + move[6], EXPOSURE.bias + move[7])
        return linearise(
            LevelProblem(model, frame, se3.exp(move[:6]) @ base, scales, exposure, 0.2)
        )

    step = 1e-5
    numerical = (total(at(step)) - total(at(-step))) / (2 * step)
    # The cost is weight * squared residual; its half has the gradient g.
    assert 2 * at(0).g[parameter] == pytest.approx(numerical, rel=2e-2, abs=1e-3 * total(at(0)))


def test_hessian_predicts_the_gradient_beside_the_optimum(use):
    use(None)
    level = wall(CAMERA)
    model = model_level(level)
    at_optimum = linearise(LevelProblem(model, level, np.eye(4), WIDE, IDENTITY, 0.2))
    for parameter in range(6):
        xi = np.zeros(6)
        xi[parameter] = 1e-3
        beside = linearise(LevelProblem(model, level, se3.exp(xi), WIDE, IDENTITY, 0.2))
        expected = at_optimum.H[:6, :6] @ xi
        reach = np.linalg.norm(expected)
        assert np.linalg.norm(beside.g[:6] - at_optimum.g[:6] - expected) < 0.1 * reach


def test_outliers_weigh_little(use):
    use(None)
    model, frame = model_level(wall(CAMERA)), wall(CAMERA)
    spoilt = frame.intensity.clone()
    spoilt[10:14, 10:40] = 1.0
    clean = linearise(LevelProblem(model, frame, np.eye(4), SCALES, IDENTITY, 0.05))
    dirty = linearise(
        LevelProblem(
            model,
            FrameLevel(CAMERA, spoilt, frame.depth_m),
            np.eye(4),
            SCALES,
            IDENTITY,
            0.05,
        )
    )
    assert clean.cost < 0.01
    # 4 % of the pixels are off by some 15 scales: squared, they would cost 9 on average.
    assert dirty.cost < 0.5


@pytest.mark.parametrize("native", [False, True])
def test_noise_of_the_frames_depth_moves_nothing(use, module, native):
    """Surfaces measured too near must not count for more than those measured too far."""
    use(module if native else None)
    level = wall(CAMERA)
    model, change = model_level(level), 0.02 * level.depth_m
    sums = []
    for depth_m in (level.depth_m + change, level.depth_m - change):
        frame = FrameLevel(CAMERA, level.intensity, depth_m)
        sums.append(linearise(LevelProblem(model, frame, np.eye(4), WIDE, IDENTITY, 0.2)).g[:6])
    assert np.linalg.norm(sums[0] + sums[1]) < 2e-3 * np.linalg.norm(sums[0])


def test_the_photometric_term_can_weigh_less(use):
    """Its share of the equations is the weight; how large residuals are stays as it is."""
    use(None)
    model, frame = model_level(wall(CAMERA)), wall(CAMERA, offset_m=0.01)
    full, none, part = (
        linearise(
            LevelProblem(
                model, frame, np.eye(4), replace(SCALES, photometric_weight=w), IDENTITY, 0.05
            )
        )
        for w in (1.0, 0.0, 0.25)
    )
    assert np.allclose(part.H, 0.25 * full.H + 0.75 * none.H)
    assert np.allclose(part.g, 0.25 * full.g + 0.75 * none.g)
    assert part.intensity_variance == full.intensity_variance > 0


def test_surfaces_behind_the_gate_take_no_part(use, room):
    use(None)
    level = level_of(room, 0)
    far = FrameLevel(level.camera, level.intensity, level.depth_m * 1.5)
    linear = linearise(LevelProblem(model_level(level), far, np.eye(4), SCALES, IDENTITY, 0.05))
    assert linear.depth_pixels < 0.05 * linear.frame_pixels


def test_cost_of_nothing_is_infinite(use):
    use(None)
    empty = FrameLevel(CAMERA, torch.zeros(48, 64), torch.zeros(48, 64))
    linear = linearise(LevelProblem(model_level(empty), empty, np.eye(4), SCALES, IDENTITY, 0.05))
    assert linear.cost == float("inf")


def test_a_pyramid_keeps_plane_and_brightness(use, room):
    use(None)
    levels = pyramid(wall(CAMERA), 3)
    assert [level.camera.size for level in levels] == [(64, 48), (32, 24), (16, 12)]
    coarse = levels[-1]
    expected = wall(coarse.camera).depth_m
    assert torch.allclose(coarse.depth_m, expected, rtol=2e-3)
    assert float(coarse.intensity.mean()) == pytest.approx(float(levels[0].intensity.mean()))


def test_halving_never_mixes_two_surfaces(use):
    use(None)
    depth = torch.ones(8, 8)
    depth[:, 3:] = 2.0  # an edge within a cell
    half = halved(FrameLevel(Camera(8, 8, 4, 4, 8, 8), torch.zeros(8, 8), depth))
    assert set(half.depth_m.unique().tolist()) == {1.0, 2.0}


def corridor(camera: Camera) -> FrameLevel:
    """A wall 0.8 m to the left, running ahead: depth grows 5 % a pixel and more."""
    x = np.arange(camera.width) - camera.width - 20.0
    depth = np.broadcast_to(0.8 * camera.fx / -x, (camera.height, camera.width))
    intensity = 0.5 + 0.4 * np.sin(depth)
    arrays = (np.ascontiguousarray(a, dtype=np.float32) for a in (intensity, depth))
    return FrameLevel(camera, *(torch.from_numpy(a) for a in arrays))


@pytest.mark.parametrize("native", [False, True])
def test_walls_along_the_view_count_on_every_level(use, module, native):
    """In a corridor all surfaces are steep: depth changes more than over many an edge."""
    use(module if native else None)
    levels = pyramid(corridor(Camera(60.0, 60.0, 95.0, 63.0, 128, 96)), 3)
    for number, level in enumerate(levels):
        gate = 0.05 * 2**number
        linear = linearise(
            LevelProblem(model_level(level), level, np.eye(4), SCALES, IDENTITY, gate)
        )
        inner = (level.camera.width - 2) * (level.camera.height - 2)
        assert linear.depth_pixels > 0.9 * inner
        assert linear.intensity_pixels > 0.8 * inner
        assert linear.depth_variance < 1e-3


@pytest.mark.parametrize("native", [False, True])
def test_steps_between_surfaces_belong_to_none(use, module, native):
    use(module if native else None)
    step = wall(CAMERA)
    step.depth_m[:, 32:] *= 1.2
    surface = model_level(step).surface[1:-1, :, 3]
    assert (surface[:, 31:33] == 0).all()
    assert (surface[:, 1:31] != 0).all() and (surface[:, 33:-1] != 0).all()


@pytest.mark.parametrize("native", [False, True])
def test_holes_do_not_darken_coarser_levels(use, module, native):
    use(module if native else None)
    level = FrameLevel(CAMERA, torch.full((48, 64), 0.6), torch.full((48, 64), 2.0))
    for image in (level.intensity, level.depth_m):
        image[::3, ::2] = 0.0
    for coarse in pyramid(level, 3)[1:]:
        assert torch.allclose(coarse.intensity, torch.tensor(0.6))
        assert torch.allclose(coarse.depth_m, torch.tensor(2.0))


def test_views_show_the_colour_as_composited(use):
    """As mapping fits it: divided by the silhouette, it would come back as exposure."""
    use(None)
    images = 0.6 * torch.ones(5, 4, 4)
    images[4, :, :2] = 0.95
    images[:3, :, :2] = 0.57
    view = view_level(surface_view(images, Camera(4, 4, 2, 2, 4, 4)), 0.9)
    assert torch.allclose(view.intensity[:, :2], torch.tensor(0.57))
    assert (view.intensity[:, 2:] == 0).all()


def test_model_levels_hold_no_border(use):
    use(None)
    model: ModelLevel = model_level(wall(CAMERA))
    for image in (model.texture, model.surface):
        border = torch.cat([image[0], image[-1], image[:, 0], image[:, -1]])
        assert not border.any()
        assert image[1:-1, 1:-1, 3].all()
