"""Times the native renderer.

    python -m benchmarks.speed.renderer [--repeats 9] [--quick]

All instruction sets that this CPU supports are measured in turn, or only that of SEMSPLAT_ISA.
--quick omits the larger scenes: a check that the program works.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
import torch
import tyro

from benchmarks.shared.results_file import RESULTS, Results, current_header
from benchmarks.shared.runner import publish
from benchmarks.shared.tables import Table, Target, target_table
from toolkit.base.geometry.camera import Camera
from toolkit.base.native import ISA_VARIABLE, available_instruction_sets, load_variant
from toolkit.base.native.tensors import address
from toolkit.splatting.gaussians.cloud import GaussianCloud
from toolkit.splatting.losses.options import RgbdLossWeights
from toolkit.splatting.rendering.backend import ForwardPass
from toolkit.splatting.rendering.native import NativeRenderer

CHANNELS = (4, 18, 30, 32, 105)
SCENES = ((320, 240, 1), (320, 240, 2), (640, 480, 2))
THREADS = 2
STEPS = ("forward", "backward")
MEASURES = ("toolkit/base/native", "toolkit/splatting/rendering")
DESCRIPTION = """\
Forward is one call that projects, sorts, bins and composites; backward returns the gradients of all
parameters and of the pose. A width of C channels is 3 colour, 1 depth and C - 4 features; the
silhouette is included. All cases of a row take turns within each repetition. Scene: one Gaussian
per pixel and layer around a wavy surface at 2 m, standard deviation 0.7-1.5 px, opacity 0.3-0.95.
The mapping loss consists of colour, SSIM and depth; its time
includes the gradient."""
Step = Callable[[], object]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Time the native renderer."""

    repeats: int = 9
    """Runs behind each median."""
    quick: bool = False
    """Only check that this works."""
    out: Path = RESULTS
    """Folder of the results file."""


def scene_camera(width: int, height: int) -> Camera:
    """A camera with a field of view of about 60 degrees."""
    focal = 0.9 * width
    return Camera(focal, focal, width / 2, height / 2, width, height)


def scene(camera: Camera, layers: int, channels: int) -> GaussianCloud:
    """One jittered Gaussian a pixel and layer, with channels - 4 features."""
    rng = np.random.default_rng(0)
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    shape = (layers, camera.height, camera.width)
    u, v = x + rng.uniform(-0.5, 0.5, shape), y + rng.uniform(-0.5, 0.5, shape)
    z = 2.0 + 0.5 * np.sin(x / 40.0) + 0.02 * rng.standard_normal(shape)
    sigma_px, opacity = rng.uniform(0.7, 1.5, shape), rng.uniform(0.3, 0.95, shape)
    means = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z
    generator = torch.Generator().manual_seed(0)
    return GaussianCloud.from_values(
        torch.from_numpy(np.stack([part.ravel() for part in means], axis=1)).float(),
        torch.from_numpy((sigma_px * z / camera.focal).ravel()).float(),
        torch.from_numpy(opacity.ravel()).float(),
        torch.rand(z.size, 3, generator=generator),
        torch.rand(z.size, channels - 4, generator=generator),
    )


class View:
    """The native backend on one cloud and camera."""

    def __init__(self, cloud: GaussianCloud, camera: Camera, instruction_set: str) -> None:
        self._backend = NativeRenderer(load_variant(instruction_set))
        self._cloud, self._camera = cloud, camera
        self._drawn: ForwardPass | None = None
        self._gradients = torch.empty(0)

    def forward(self) -> None:
        """Draw."""
        self._drawn = None  # hands its buffers to this view, as in a running system
        self._drawn = self._backend.forward(
            self._cloud, self._camera, np.eye(4), self._cloud.features, None
        )

    def backward(self) -> None:
        """Gradients of the view drawn last."""
        assert self._drawn is not None
        if self._gradients.shape != self._drawn.images.shape:
            generator = torch.Generator().manual_seed(1)
            self._gradients = torch.randn(self._drawn.images.shape, generator=generator)
        self._drawn.backward(self._gradients)


def medians_ms(steps: dict[tuple, Step], repeats: int) -> dict[tuple, float]:
    """Median time of each step, all run in turn; the last part of a key is the threads."""
    times: dict[tuple, list[float]] = {key: [] for key in steps}
    for repeat in range(repeats + 1):
        for key, call in steps.items():
            torch.set_num_threads(key[-1])
            start = time.perf_counter()
            call()
            if repeat:  # the first round warms caches and buffers
                times[key].append(1e3 * (time.perf_counter() - start))
    return {key: statistics.median(values) for key, values in times.items()}


def measure(
    cloud: GaussianCloud,
    camera: Camera,
    names: Sequence[str],
    repeats: int,
    threads: tuple[int, ...] = (THREADS,),
) -> dict[tuple, float]:
    """Median times by instruction set, step and number of threads."""
    views = {name: View(cloud, camera, name) for name in names}
    steps: dict[tuple, Step] = {
        (name, step, count): getattr(view, step)
        for name, view in views.items()
        for count in threads
        for step in STEPS
    }
    return medians_ms(steps, repeats)


def instruction_sets() -> list[str]:
    """The instruction sets to measure, the best one last."""
    forced = os.environ.get(ISA_VARIABLE)
    return [forced] if forced else available_instruction_sets()


def row(*cells: object) -> tuple[str, ...]:
    """One row; floats with two digits."""
    return tuple(f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in cells)


def width_table(scenes: tuple[tuple[int, int, int], ...], repeats: int) -> Table:
    """Every width on every scene and instruction set, and the gain of a second thread."""
    columns = ("Gaussians", "image", "channels", "instruction set", "forward ms", "backward ms")
    gains = (f"gain of {THREADS} threads, forward", "gain, backward")
    rows = []
    for width, height, layers in scenes:
        camera = scene_camera(width, height)
        for channels in CHANNELS:
            cloud = scene(camera, layers, channels)
            ms = measure(cloud, camera, instruction_sets(), repeats, (1, THREADS))
            for name in instruction_sets():
                times = [ms[name, step, THREADS] for step in STEPS]
                gained = [ms[name, step, 1] / ms[name, step, THREADS] for step in STEPS]
                size = f"{width}x{height}"
                rows.append(row(len(cloud), size, channels, name, *times, *gained))
    return Table((*columns, *gains), tuple(rows))


def loss_table(repeats: int) -> Table:
    """The mapping loss with its gradient on every instruction set."""
    height, width = 240, 320
    generator = torch.Generator().manual_seed(0)
    images, rgb, depth = (torch.rand(c, height, width, generator=generator) for c in (5, 3, 1))
    gradient = torch.empty_like(images)
    addresses = [address(t) for t in (images, rgb, depth, depth.clone())]

    def loss(name: str) -> Step:
        module, weights = load_variant(name), astuple(RgbdLossWeights())
        return lambda: module.rgbd_loss((width, height), addresses, weights, address(gradient))

    steps: dict[tuple, Step] = {(name, THREADS): loss(name) for name in instruction_sets()}
    ms = medians_ms(steps, 3 * repeats)
    last = list(ms.values())[-1]
    columns = ("instruction set", f"mapping loss at {width}x{height}, ms", "times the last row's")
    rows = tuple(row(name, time_ms, time_ms / last) for (name, _), time_ms in ms.items())
    return Table(columns, rows, "Mapping loss")


def main() -> None:
    """Measure all tables."""
    options = tyro.cli(Options)
    if not instruction_sets():
        raise SystemExit("the native kernels are not built; run make ready")
    header = current_header([0], MEASURES, str(THREADS))
    header = replace(header, instruction_set=", ".join(instruction_sets()))
    scenes = SCENES[:1] if options.quick else SCENES
    loss = loss_table(options.repeats)
    tables = [width_table(scenes, options.repeats), loss]
    times = {cells[0]: float(cells[1]) for cells in loss.rows}
    ratio = times["avx2"] / times["avx512"] if {"avx2", "avx512"} <= times.keys() else None
    tables.append(target_table([Target("mapping loss: avx2 / avx512", ratio, at_most=2.5)]))
    description = f"{DESCRIPTION} Medians of {options.repeats}."
    results = Results("renderer", "Native renderer", description, header, tuple(tables))
    if options.quick:
        print(results.markdown())
    else:
        publish(results, options.out)


if __name__ == "__main__":
    main()
