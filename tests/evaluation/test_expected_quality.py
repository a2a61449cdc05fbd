"""What neighbouring images allow, and warnings of maps that are far worse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from toolkit.base.frame import Frame
from toolkit.base.geometry.camera import Camera
from toolkit.runs.evaluation.expected_quality import expected_metrics, shortfall_warnings
from toolkit.runs.evaluation.neighbouring_images import SmallView

Image = NDArray[np.float32]

CAMERA = Camera(100.0, 100.0, 47.5, 31.5, 96, 64)
FRAMES = 8
Change = Callable[[SmallView], SmallView]


@cache
def painting() -> Image:
    painted = np.random.default_rng(3).random((80, 200, 3)).astype(np.float32)
    painted = np.asarray(cv2.GaussianBlur(painted, (0, 0), 2.0))
    return np.asarray((painted - painted.min()) / np.ptp(painted))


def wall(shift_px: float = 0.0) -> Image:
    """An image of a painted wall, seen from farther to the right."""
    move = np.array([[1.0, 0.0, -20.0 - shift_px], [0.0, 1.0, -8.0]], np.float32)
    return np.asarray(cv2.warpAffine(painting(), move, CAMERA.size, flags=cv2.INTER_CUBIC))


@dataclass
class Wall:
    """Frames of a camera that moves along a wall at 2 m, with noise."""

    noise: float = 0.01
    depth_m: float = 2.0
    name = "wall"

    def __len__(self) -> int:
        return FRAMES

    def __getitem__(self, index: int) -> Frame:
        random = np.random.default_rng(index)
        rgb = wall(2.0 * index) + self.noise * random.standard_normal((64, 96, 3))
        depth_m = self.depth_m * (1.0 + 0.003 * random.standard_normal((64, 96)))
        rgb, depth_m = rgb.clip(0.0, 1.0).astype(np.float32), depth_m.astype(np.float32)
        return Frame(index, index / 30.0, rgb, depth_m, CAMERA)


def right_view(frame: Frame) -> SmallView:
    exact = np.full((64, 96), 2.0, np.float32)
    seen = np.ones((64, 96), bool)
    rgb, painted = frame.rgb, wall(2.0 * frame.index).clip(0.0, 1.0)
    return SmallView(frame.index, CAMERA, rgb, frame.depth_m, painted, exact, seen, CAMERA.size)


def metrics(change: Change = lambda view: view, dataset: Wall | None = None) -> dict[str, Any]:
    dataset = dataset or Wall()
    views = [change(right_view(dataset[index])) for index in range(FRAMES)]
    found = expected_metrics(views, dataset)  # type: ignore[arg-type]
    return {"expected": found, "trajectory": {"alignment": "se3"}}


def beside(view: SmallView) -> SmallView:
    """A map whose colours are 1.5 pixels off."""
    return replace(view, map_rgb=wall(2.0 * view.index + 1.5))


def ghosted(view: SmallView) -> SmallView:
    """A map that shows everything twice."""
    return replace(view, map_rgb=0.5 * (wall(2.0 * view.index - 2.0) + wall(2.0 * view.index + 2)))


def darker(view: SmallView) -> SmallView:
    return replace(view, map_rgb=0.8 * view.map_rgb)


def curved(view: SmallView) -> SmallView:
    """A map whose surface is up to 4 % too near."""
    return replace(view, map_depth=view.map_depth * np.linspace(0.96, 1.0, 96, dtype=np.float32))


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.05])
def test_a_right_map_is_as_good_as_neighbouring_images(noise: float) -> None:
    found = metrics(dataset=Wall(noise))
    assert found["expected"]["views"] == FRAMES
    assert found["expected"]["shortfall_db"] < 1.0
    assert found["expected"]["offset_px"] < 0.2
    assert shortfall_warnings(found) == []


@pytest.mark.parametrize(("wrong", "reported"), [(3, False), (7, True)])
def test_most_views_must_be_worse(wrong: int, reported: bool) -> None:
    found = metrics(lambda view: beside(view) if view.index < wrong else view)
    assert bool(shortfall_warnings(found)) is reported


def test_noise_lowers_what_is_expected() -> None:
    low, high = (metrics(dataset=Wall(noise))["expected"]["expected_db"] for noise in (0.0, 0.05))
    # The noise of both images: 20 log10(0.05 sqrt(2)).
    assert high == pytest.approx(23.0, abs=1.0)
    assert low > high + 10.0


@pytest.mark.parametrize("change", [beside, ghosted])
def test_a_map_that_is_off_is_reported(change: Change) -> None:
    found = metrics(change)
    first, reasons = shortfall_warnings(found)
    assert f"{found['expected']['expected_db']:.1f} dB" in first
    assert "Likely reasons, in this order: intrinsics" in reasons
    assert "check-data" in reasons


def test_what_is_reported_already_is_the_first_reason() -> None:
    _, reasons = shortfall_warnings(metrics(beside), reported=True)
    assert "order: what the checks of the recording report above; " in reasons
    assert "check-data" not in reasons


def test_given_poses_and_doubtful_frames_are_reasons() -> None:
    found = metrics(beside) | {
        "trajectory": {"alignment": "none"},
        "frames": {"doubtful": 5, "lost": 0, "total": 8},
    }
    _, reasons = shortfall_warnings(found)
    assert "order: 5 of 8 frames are doubtful or lost; given poses" in reasons


def test_skipped_steps_and_baselines_are_reasons() -> None:
    found = metrics(beside) | {"pace": {"mapping_steps_skipped": 40, "mapping_steps_due": 100}}
    _, reasons = shortfall_warnings(found, baseline=True)
    assert "order: the methods of a baseline (tracking.kind); frames or steps of the opt" in reasons


def test_unmodelled_exposure_is_named() -> None:
    _, reasons = shortfall_warnings(metrics(darker))
    assert "order: changes of exposure" in reasons


def test_wrong_depth_is_reported_although_colours_agree() -> None:
    found = metrics(curved)
    first, _ = shortfall_warnings(found)
    assert found["expected"]["shortfall_db"] < 1.0
    assert "its depth differs" in first
    assert found["expected"]["reached_depth_percent"] == pytest.approx(2.0, abs=0.2)


def test_pixels_without_depth_and_ignored_ones_do_not_count() -> None:
    def partly(view: SmallView) -> SmallView:
        left = np.arange(96) < 40
        painted = np.where(left[:, None], np.float32(0.0), view.map_rgb)
        return replace(view, map_rgb=painted, compared=view.compared & ~left)

    assert shortfall_warnings(metrics(partly)) == []


def test_images_that_are_too_small_for_flow_are_not_compared() -> None:
    def low(view: SmallView) -> SmallView:
        camera = replace(CAMERA, height=8)
        images = {n: vars(view)[n][:8] for n in ("rgb", "map_rgb", "map_depth", "compared")}
        return replace(view, camera=camera, depth_m=None, **images)

    assert metrics(low)["expected"]["views"] == 0


def test_too_few_views_are_not_judged() -> None:
    dataset = Wall()
    views = [beside(right_view(dataset[index])) for index in range(3)]
    found = expected_metrics(views, dataset)  # type: ignore[arg-type]
    assert found["views"] == 3
    assert shortfall_warnings({"expected": found}) == []
    assert expected_metrics([], dataset)["expected_db"] is None  # type: ignore[arg-type]
