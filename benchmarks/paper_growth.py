"""Growth of time and memory, with fitted exponents."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence

import numpy as np
import torch

from benchmarks.paper_runs import PaperRuns
from benchmarks.tables import Metrics, Table
from toolkit.base.geometry.camera import Camera
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.rendering import backend

GAUSSIANS: tuple[int, ...] = (25_000, 50_000, 100_000, 200_000, 400_000)
WIDTHS: tuple[int, ...] = (80, 160, 320, 640)
CHANNELS: tuple[int, ...] = (0, 8, 16, 32, 64, 128)
_REPEATS = 5


def growth_table(runs: PaperRuns, quick: bool) -> Table:
    """Time of a rendering with its backward pass, and of runs, by what they grow with."""
    gaussians, widths, channels = GAUSSIANS, WIDTHS, CHANNELS
    if quick:
        gaussians, widths, channels = gaussians[:3], widths[:3], channels[:3]
    rows = [
        _row("Gaussians", "ms", gaussians, lambda n: render_ms(n, 320, 0)),
        _row(
            "pixels",
            "ms",
            tuple(w * w * 3 // 4 for w in widths),
            lambda n: render_ms(100_000, round((n * 4 / 3) ** 0.5), 0),
        ),
        _row("semantic channels", "ms", channels, lambda n: render_ms(100_000, 320, n)),
    ]
    found = sorted(runs.metrics("growth", "default"), key=lambda run: run["frames.total"])
    frames = tuple(int(run["frames.total"]) for run in found)
    for unit, value in _RUN_VALUES.items():
        values = [value(run) for run in found]
        rows.append(("frames", unit, _listed(frames), _listed(values), exponent(frames, values)))
    return Table(
        ("grows with", "value", "at", "measured", "exponent"),
        tuple(rows),
        "Growth",
        "One view of 320x240 with 100,000 Gaussians where not varied, forward and backward pass, "
        "medians of five; runs are the first frames of a ring of rooms (160x120), default "
        "settings. The exponent is the slope of a line through the logarithms; for channels, of "
        "the part that they add.",
    )


_RUN_VALUES: dict[str, Callable[[Metrics], float]] = {
    "s, tracking and mapping": lambda run: (
        1e-3 * run["time.online_ms_per_frame"] * run["frames.total"]
    ),
    "s, refinement": lambda run: 1e-3 * run["time.refinement_ms_per_frame"] * run["frames.total"],
    "MB, map": lambda run: run["memory.map_mb"],
    "MB, peak": lambda run: run["memory.peak_mb"],
}


def _row(
    what: str, unit: str, sizes: Sequence[int], measure: Callable[[int], float]
) -> tuple[str, ...]:
    values = [measure(size) for size in sizes]
    base = values[0] if sizes[0] == 0 else 0.0
    pairs = [(s, v - base) for s, v in zip(sizes, values, strict=True) if s > 0]
    slope = exponent([s for s, _ in pairs], [v for _, v in pairs])
    return (what, unit, _listed(sizes), _listed(values), slope)


def render_ms(count: int, width: int, channels: int) -> float:
    """Time of a forward and a backward pass over a wall of Gaussians that fills the image."""
    generator = torch.Generator().manual_seed(0)
    camera = Camera(0.9 * width, 0.9 * width, width / 2, width * 3 / 8, width, width * 3 // 4)
    means = torch.rand(count, 3, generator=generator) - 0.5
    means = means * torch.tensor([2.4, 1.8, 0.2]) + torch.tensor([0.0, 0.0, 2.0])
    cloud = GaussianCloud.from_values(
        means=means,
        radii_m=torch.full((count,), 1.2 / count**0.5),
        opacities=torch.full((count,), 0.9),
        colours=torch.rand(count, 3, generator=generator),
        features=torch.rand(count, channels, generator=generator),
    )
    features = cloud.features if channels else None
    times = []
    for _ in range(_REPEATS + 1):
        begin = time.perf_counter()
        view = backend().forward(cloud, camera, np.eye(4), features, None)
        view.backward(torch.ones_like(view.images))
        times.append(1e3 * (time.perf_counter() - begin))
    return statistics.median(times[1:])


def exponent(sizes: Sequence[float], values: Sequence[float]) -> str:
    """Slope of the logarithms as text; n/a with fewer than two positive values."""
    pairs = [(s, v) for s, v in zip(sizes, values, strict=True) if s > 0 and v > 0]
    if len(pairs) < 2:
        return "n/a"
    logarithms = np.log(np.array(pairs, float))
    return f"{np.polyfit(logarithms[:, 0], logarithms[:, 1], 1)[0]:.2f}"


def _listed(values: Sequence[float]) -> str:
    return ", ".join(f"{value:,}" if isinstance(value, int) else f"{value:.3g}" for value in values)
