"""Times the native renderer.

    python -m benchmarks.renderer [--repeats 9] [--rival RAS_CPP] [--quick]

All instruction sets that this CPU supports are measured in turn, or only that of SEMSPLAT_ISA.
--rival takes the C++ source of a rasteriser with the functions `bin`, `fwd` and `bwd` (widths 4, 7,
24 and 32), compiles it for each instruction set, and adds a table of its times and ours. --quick
omits the larger scenes and the growth tables: a check that the program works.
"""

from __future__ import annotations

import argparse
import math
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import astuple, replace
from pathlib import Path

import torch

from benchmarks.renderer_contestants import Ours, Rival, compiled, make_scene
from benchmarks.report import publish
from benchmarks.results_file import RESULTS, Results, current_header
from benchmarks.tables import Table, Target, target_table
from toolkit.base.native import ISA_VARIABLE, available_instruction_sets, load_variant
from toolkit.base.native.tensors import address
from toolkit.splatting.losses.options import RgbdLossWeights

CHANNELS = (4, 18, 30, 32, 105)
RIVAL_CHANNELS = (4, 7, 24, 32)
SCENES = ((320, 240, 1), (320, 240, 2), (640, 480, 2))
THREADS = 2
MEASURES = ("toolkit/base/native", "toolkit/splatting/rendering")
COMPARISON = "Compared with another rasteriser"
DESCRIPTION = """\
Forward is one call that projects, sorts, bins and composites; backward returns the gradients of all
parameters and of the pose. A width of C channels is 3 colour, 1 depth and C - 4 features; the
silhouette is included. All cases of a row take turns within each repetition. Scene: one Gaussian
per pixel and layer around a wavy surface at 2 m, standard deviation 0.7-1.5 px, opacity 0.3-0.95.
An exponent of 1 is linear growth. The mapping loss consists of colour, SSIM and depth; its time
includes the gradient. The other rasteriser is compiled with -O3 -ffast-math for the same
instruction set. Its forward pass is argsort, binning and compositing; its ratio is its time divided
by ours."""
Step = Callable[[], None]


def interleaved_medians_ms(steps: dict[str, tuple[int, Step]], repeats: int) -> dict[str, float]:
    """Median time of each step, all run in turn; a step is (threads, call)."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(repeats + 1):
        for name, (threads, call) in steps.items():
            torch.set_num_threads(threads)
            start = time.perf_counter()
            call()
            if repeat:  # the first round warms caches and buffers
                times[name].append(1e3 * (time.perf_counter() - start))
    return {name: statistics.median(values) for name, values in times.items()}


def measure(
    contestants: dict[str, Ours], repeats: int, threads: tuple[int, ...] = (THREADS,)
) -> dict[tuple[str, str, int], float]:
    """Median times by instruction set, step ("forward" or "backward") and number of threads."""
    steps: dict[str, tuple[int, Step]] = {}
    keys = {}
    for name, ours in contestants.items():
        for count in threads:
            for step, call in (("forward", ours.forward), ("backward", ours.backward)):
                steps[f"{name} {step} {count}"] = (count, call)
                keys[f"{name} {step} {count}"] = (name, step, count)
    ms = interleaved_medians_ms(steps, repeats)
    return {key: ms[name] for name, key in keys.items()}


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
        scene = make_scene(width, height, layers)
        for channels in CHANNELS:
            cloud = scene.cloud(channels)
            ours = {name: Ours(cloud, scene.camera, name) for name in instruction_sets()}
            ms = measure(ours, repeats, (1, THREADS))
            for name in ours:
                times = [ms[name, step, THREADS] for step in ("forward", "backward")]
                single = [ms[name, step, 1] for step in ("forward", "backward")]
                cells = (len(scene), f"{width}x{height}", channels, name, *times)
                rows.append(row(*cells, single[0] / times[0], single[1] / times[1]))
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

    steps = {name: (THREADS, loss(name)) for name in instruction_sets()}
    ms = interleaved_medians_ms(steps, 3 * repeats)
    rows = [row(name, ms[name], ms[name] / ms[instruction_sets()[-1]]) for name in steps]
    columns = ("instruction set", f"mapping loss at {width}x{height}, ms", "times the last row's")
    return Table(columns, tuple(rows), "Mapping loss")


def growth_tables(repeats: int) -> Iterator[Table]:
    """Time against the number of Gaussians, then of pixels, the other held still.

    The exponent is that of a power law through this row and the one before: 1 is linear.
    """
    small = make_scene(320, 240, 1)
    more = [(len(s), s.cloud(4), s.camera) for s in (make_scene(320, 240, n) for n in (1, 2, 4))]
    cloud, camera = make_scene(320, 240, 2).cloud(4), small.camera
    finer = []
    for scale in (1, 2, 4):
        zoomed = camera.scaled(scale, scale, scale * camera.width, scale * camera.height)
        finer.append((zoomed.width * zoomed.height, cloud, zoomed))
    best = instruction_sets()[-1]
    for name, points in (("Gaussians at 320x240", more), ("pixels of 153600 Gaussians", finer)):
        columns = (name, "forward ms", "backward ms", "forward exponent", "backward exponent")
        rows = []
        before: tuple[int, float, float] | None = None
        for size, gaussians, view in points:
            ms = measure({best: Ours(gaussians, view, best)}, repeats)
            now = size, ms[best, "forward", THREADS], ms[best, "backward", THREADS]
            rows.append(row(*now, *(exponents(before, now) if before else ("", ""))))
            before = now
        yield Table(columns, tuple(rows), f"Growth with {name}")


def exponents(a: tuple[int, float, float], b: tuple[int, float, float]) -> tuple[float, float]:
    """Powers with which the two times grow from (size, time, time) a to b."""
    growth = math.log(b[0] / a[0])
    return math.log(b[1] / a[1]) / growth, math.log(b[2] / a[2]) / growth


def rival_table(source: Path, scenes: tuple[tuple[int, int, int], ...], repeats: int) -> Table:
    """Our times and the rival's; a ratio above 1 means that ours is faster."""
    columns = ("Gaussians", "image", "channels", "instruction set")
    forward = ("forward ms", "rival's forward ms", "ratio")
    backward = ("backward ms", "rival's backward ms", "ratio, backward")
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        libraries = {name: compiled(source, name, Path(folder)) for name in instruction_sets()}
        for width, height, layers in scenes:
            scene = make_scene(width, height, layers)
            for channels in RIVAL_CHANNELS:
                cloud = scene.cloud(channels)
                steps: dict[str, tuple[int, Step]] = {}
                for name, library in libraries.items():
                    ours = Ours(cloud, scene.camera, name)
                    rival = Rival(library, scene, channels)
                    steps[f"{name} forward"] = (THREADS, ours.forward)
                    steps[f"{name} rival forward"] = (THREADS, rival.forward)
                    steps[f"{name} backward"] = (THREADS, ours.backward)
                    steps[f"{name} rival backward"] = (THREADS, rival.backward)
                ms = interleaved_medians_ms(steps, repeats)
                for name in libraries:
                    cells: list[object] = [len(scene), f"{width}x{height}", channels, name]
                    for step in ("forward", "backward"):
                        own, other = ms[f"{name} {step}"], ms[f"{name} rival {step}"]
                        cells += [own, other, other / own]
                    rows.append(row(*cells))
    return Table((*columns, *forward, *backward), tuple(rows), COMPARISON)


def targets(loss: Table, comparison: Table) -> list[Target]:
    """The extreme ratio over all rows of an instruction set against its bound."""
    rows = [dict(zip(comparison.columns, cells, strict=True)) for cells in comparison.rows]
    by_set = {
        name: [r for r in rows if r["instruction set"] == name] for name in instruction_sets()
    }
    found = []
    for name, bound in (("avx2", 1.8), ("avx512", 2.0)):
        for step, column in (("forward", "ratio"), ("backward", "ratio, backward")):
            ratios = [float(r[column]) for r in by_set.get(name, [])]
            label = f"{step} pass, {name}: rival's time / ours, least of all rows"
            found.append(Target(label, min(ratios, default=None), at_least=bound))
    pairs = list(zip(by_set.get("avx2", []), by_set.get("avx512", []), strict=False))
    for step, widths, bound in (
        ("forward", RIVAL_CHANNELS, 1.5),
        ("backward", (4, 7), 1.5),
        ("backward", (24, 32), 1.8),
    ):
        column = f"{step} ms"
        ratios = [
            float(narrow[column]) / float(wide[column])
            for narrow, wide in pairs
            if int(wide["channels"]) in widths
        ]
        label = f"{step} pass, {min(widths)} to {max(widths)} channels: avx2 / avx512, greatest"
        found.append(Target(label, max(ratios, default=None), at_most=bound))
    times = {cells[0]: float(cells[1]) for cells in loss.rows}
    ratio = times["avx2"] / times["avx512"] if {"avx2", "avx512"} <= times.keys() else None
    found.append(Target("mapping loss: avx2 / avx512", ratio, at_most=2.5))
    return found


def main() -> None:
    """Measure all tables."""
    parser = argparse.ArgumentParser(description="Time the native renderer.")
    parser.add_argument("--repeats", type=int, default=9, help="runs behind each median")
    parser.add_argument("--rival", type=Path, help="C++ source of the rough prototype")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results file")
    parser.add_argument("--quick", action="store_true", help="only check that this works")
    arguments = parser.parse_args()
    if arguments.repeats < 1:
        parser.error("--repeats must be at least 1")
    if arguments.rival and not arguments.rival.is_file():
        parser.error(f"--rival {arguments.rival} is not a file")
    scenes = SCENES[:1] if arguments.quick else SCENES
    if not instruction_sets():
        parser.error("the native kernels are not built; run make ready")
    header = current_header([0], MEASURES, str(THREADS))
    header = replace(header, instruction_set=", ".join(instruction_sets()))
    tables = [width_table(scenes, arguments.repeats), loss_table(arguments.repeats)]
    if not arguments.quick:
        tables += growth_tables(arguments.repeats)
    if arguments.rival:
        tables.append(rival_table(arguments.rival.resolve(), scenes, arguments.repeats))
        tables.append(target_table(targets(tables[1], tables[-1])))
    title = "Native renderer"
    description = f"{DESCRIPTION} Medians of {arguments.repeats}."
    results = Results("renderer", title, description, header, tuple(tables))
    if arguments.quick:
        print(results.markdown())
    else:
        publish(results, arguments.out)


if __name__ == "__main__":
    main()
