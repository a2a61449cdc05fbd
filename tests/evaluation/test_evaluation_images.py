"""PSNR, SSIM, MS-SSIM and depth L1: against torchmetrics and on known answers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from toolkit.runs.evaluation.depth import depth_l1
from toolkit.runs.evaluation.images import (
    MAX_PSNR_DB,
    mean_or_none,
    psnr_db,
    ssim_and_ms_ssim,
)


def image_pair(height: int, width: int, noise: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(height * width)
    rows, columns = np.mgrid[0:height, 0:width]
    waves = [np.sin(rows / (3.0 + c)) * np.cos(columns / (5.0 + c)) for c in range(3)]
    truth = (0.5 + 0.4 * np.stack(waves, axis=-1)).astype(np.float32)
    rendered = truth + generator.normal(scale=noise, size=truth.shape).astype(np.float32)
    return rendered.clip(0, 1).astype(np.float32), truth


def as_batch(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None].double()


@pytest.mark.parametrize("size", [(48, 64), (37, 51)])
def test_psnr_and_ssim_agree_with_torchmetrics(size: tuple[int, int]) -> None:
    functional = pytest.importorskip("torchmetrics.functional.image")
    rendered, truth = image_pair(*size)
    a, b = as_batch(rendered), as_batch(truth)
    theirs = functional.peak_signal_noise_ratio(a, b, data_range=1.0)
    assert psnr_db(rendered, truth) == pytest.approx(float(theirs), abs=1e-4)
    theirs = functional.structural_similarity_index_measure(a, b, sigma=1.5, data_range=1.0)
    assert ssim_and_ms_ssim(rendered, truth)[0] == pytest.approx(float(theirs), abs=1e-5)


@pytest.mark.parametrize(("size", "noise"), [((176, 200), 0.05), ((191, 181), 0.3)])
def test_ms_ssim_agrees_with_torchmetrics(size: tuple[int, int], noise: float) -> None:
    functional = pytest.importorskip("torchmetrics.functional.image")
    rendered, truth = image_pair(*size, noise)
    theirs = functional.multiscale_structural_similarity_index_measure(
        as_batch(rendered), as_batch(truth), sigma=1.5, data_range=1.0
    )
    assert ssim_and_ms_ssim(rendered, truth)[1] == pytest.approx(float(theirs), abs=1e-5)


def test_torch_and_numpy_images_have_the_same_scores() -> None:
    rendered, truth = image_pair(180, 180)
    tensors = torch.from_numpy(rendered).requires_grad_(), torch.from_numpy(truth)
    for metric in (psnr_db, ssim_and_ms_ssim):
        assert metric(*tensors) == metric(rendered, truth)


def test_a_copy_is_perfect() -> None:
    _, truth = image_pair(180, 180)
    assert psnr_db(truth, truth) == MAX_PSNR_DB
    assert ssim_and_ms_ssim(truth, truth) == pytest.approx((1.0, 1.0))


def test_psnr_of_a_uniform_offset() -> None:
    grey = np.full((4, 5, 3), 0.5, np.float32)
    assert psnr_db(grey + 0.1, grey) == pytest.approx(20.0, abs=1e-4)


def test_small_images_have_no_score_rather_than_another_metric() -> None:
    rendered, truth = image_pair(175, 300)
    similarity, multi_scale = ssim_and_ms_ssim(rendered, truth)
    assert similarity is not None and multi_scale is None
    assert ssim_and_ms_ssim(rendered[:10], truth[:10]) == (None, None)
    assert mean_or_none([None, 0.5, 0.7]) == pytest.approx(0.6)
    assert mean_or_none([None]) is None


def test_images_of_different_size_are_refused() -> None:
    rendered, truth = image_pair(20, 20)
    with pytest.raises(ValueError, match="the same size"):
        psnr_db(rendered[:-1], truth)
    with pytest.raises(ValueError, match=r"\[H, W, 3\]"):
        ssim_and_ms_ssim(rendered[..., 0], truth[..., 0])


def test_depth_counts_only_pixels_that_both_images_hold() -> None:
    measured = np.array([[1.0, 2.0, 0.0, 3.0]], np.float32)
    rendered = np.array([[1.1, np.nan, 5.0, 2.7]], np.float32)
    error = depth_l1(rendered, measured)
    assert error.l1_m == pytest.approx(0.2, abs=1e-6)
    assert error.coverage == pytest.approx(2 / 3)


def test_depth_without_a_common_pixel_is_not_available() -> None:
    error = depth_l1(np.zeros((2, 2)), np.ones((2, 2)))
    assert (error.l1_m, error.coverage) == (None, 0.0)
