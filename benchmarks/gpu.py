"""Checks the GPU renderer, times it beside gsplat and beside what the machine could do.

    python benchmarks/gpu.py                    on a machine with a CUDA device
    python benchmarks/gpu.py --smoke            anywhere: tiny, through Triton's interpreter
    python benchmarks/gpu.py --compile-only     anywhere: what each kernel uses, as compiled

It needs torch, triton, numpy, OpenCV and scikit-learn, and nothing of this project installed.
gsplat takes part where it is installed, with its own defaults but for the 0.3 square pixels
by which it widens every Gaussian.

C channels are 3 colour, 1 depth and C - 4 features; the silhouette comes with them, and the
backward pass gives all gradients and the pose's. Times are medians of CUDA events, contestants
in turn. Floors: the bytes that must move (inputs read once, outputs written once) over the
bandwidth of a large copy; the operations that must be done over the rate of a large float32
matrix product.
"""

from __future__ import annotations

import argparse
import functools
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
if "--smoke" in sys.argv and not torch.cuda.is_available():
    os.environ["TRITON_INTERPRET"] = "1"  # before Triton is imported
if "--compile-only" in sys.argv:
    os.environ.pop("TRITON_INTERPRET", None)

from gpu_scene import (  # type: ignore[import-not-found]
    camera_of,
    pose_of,
    surface_cloud,
    touched_pixels,
    walk,
)

from toolkit.errors import DependencyError
from toolkit.frame import Frame
from toolkit.gaussians.cloud import GaussianCloud
from toolkit.geometry import se3
from toolkit.geometry.camera import Camera
from toolkit.mapping.mapper import Mapper, MapperOptions
from toolkit.rendering import GaussianGradients, backend
from toolkit.rendering.backend import Backend, ForwardPass
from toolkit.rendering.native import available_instruction_sets
from toolkit.rendering.reference import ReferenceBackend
from toolkit.tracking.dense import DenseOptions, DenseTracker

CHANNELS = (4, 18, 30, 105)
MILLIONS = (0.5, 1.0, 3.0)
SIZE = (1200, 680)
UNTIMED = "interpreter"


@dataclass(frozen=True)
class Plan:
    """What to measure, and on what."""

    device: str
    size: tuple[int, int]
    counts: tuple[int, ...]
    channels: tuple[int, ...]
    repeats: int
    frames: int

    @property
    def timed(self) -> bool:
        """Whether times mean anything: the interpreter's do not."""
        return self.device == "cuda"


@functools.cache
def contestants() -> dict[str, Backend]:
    """Ours, and gsplat where it can run."""
    found = {"ours": backend("cuda")}
    try:
        found["gsplat"] = backend("gsplat")
    except DependencyError as error:
        print(f"Without gsplat: {error}.")
    return found


def table(*columns: str) -> None:
    """Start a Markdown table."""
    print("\n| " + " | ".join(columns) + " |")
    print("|" + " ---: |" * len(columns))


def row(*cells: object) -> None:
    """One row of a Markdown table."""
    texts = [f"{c:.3g}" if isinstance(c, float) else str(c) for c in cells]
    print("| " + " | ".join(texts) + " |", flush=True)


# Correctness


def check(plan: Plan) -> bool:
    """Largest error of each contestant against float64; whether ours is within its bounds."""
    table("channels", "backend", "images", "gradients", "pose gradient", "bound", "")
    passed = True
    for channels in plan.channels:
        camera = camera_of(64, 40) if plan.timed else camera_of(20, 16)
        count = 4000 if plan.timed else 120
        cloud = surface_cloud(camera, count, channels - 4, seed=channels)
        exact = GaussianCloud(*(getattr(cloud, f.name).double() for f in fields(cloud)))
        generator = torch.Generator().manual_seed(channels)
        weights = torch.randn(channels + 1, camera.height, camera.width, generator=generator)
        expected = _drawn(ReferenceBackend(), exact, camera, weights.double())
        # Eleven bits a factor in tf32, and alphas at the cut that fall either way.
        bound = 1e-2 if plan.timed else 2e-3
        for name, contestant in contestants().items():
            actual = _drawn(contestant, cloud.to(plan.device), camera, weights.to(plan.device))
            errors = [_error(a, b) for a, b in zip(actual, expected, strict=True)]
            good = name != "ours" or max(errors) <= bound
            passed &= good
            row(channels, name, *errors, bound, "" if name != "ours" else "ok" if good else "WRONG")
    return passed


def _drawn(
    contestant: Backend, cloud: GaussianCloud, camera: Camera, weights: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """Images, all gradients in one row, and the pose's, in float64 on the CPU."""
    pose = se3.exp(np.array([0.01, -0.02, 0.015, 0.01, -0.02, 0.01]))
    drawn = contestant.forward(cloud, camera, pose, cloud.features, None)
    found = drawn.backward(weights)
    assert found.colours is not None
    dense = torch.zeros(len(cloud), 8 + cloud.features.shape[1], dtype=torch.float64)
    columns = [found.means, found.log_radii[:, None], found.opacity_logits[:, None]]
    dense[found.ids.cpu()] = torch.cat([*columns, found.colours, found.features], 1).double().cpu()
    return drawn.images.double().cpu(), dense, found.T_camera_map.cpu()


def _error(actual: torch.Tensor, expected: torch.Tensor) -> float:
    """Root of the mean square error, relative to the truth's."""
    return float((actual - expected).norm() / expected.norm())


# Speed


class Contest:
    """One contestant on one scene."""

    def __init__(self, contestant: Backend, cloud: GaussianCloud, camera: Camera) -> None:
        self._backend, self._cloud, self._camera = contestant, cloud, camera
        self._drawn: ForwardPass | None = None
        channels = 5 + cloud.features.shape[1]
        shape = (channels, camera.height, camera.width)
        generator = torch.Generator().manual_seed(1)
        self._weights = torch.randn(shape, generator=generator).to(cloud.means.device)

    def forward(self) -> None:
        """Draw."""
        cloud = self._cloud
        self._drawn = None
        self._drawn = self._backend.forward(cloud, self._camera, np.eye(4), cloud.features, None)

    def backward(self) -> GaussianGradients:
        """Gradients of the view drawn last."""
        assert self._drawn is not None
        return self._drawn.backward(self._weights)


def medians_ms(steps: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median of each step on the GPU, all in turn, after three rounds of warming up."""
    times: dict[str, list[float]] = {name: [] for name in steps}
    for repeat in range(repeats + 3):
        for name, step in steps.items():
            start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
            start.record()
            step()
            end.record()
            end.synchronize()
            if repeat >= 3:
                times[name].append(start.elapsed_time(end))
    return {name: statistics.median(values) for name, values in times.items()}


def ceilings(plan: Plan) -> tuple[float, float]:
    """Bytes a second of a large copy, read and written, and float32 operations a second."""
    if not plan.timed:
        return float("nan"), float("nan")
    source = torch.randn(2**28, device="cuda")
    target = torch.empty_like(source)
    a, b = (torch.randn(8192, 8192, device="cuda") for _ in range(2))
    torch.backends.cuda.matmul.allow_tf32 = False
    steps = {"copy": lambda: target.copy_(source), "product": lambda: a @ b}
    ms = medians_ms(steps, plan.repeats)
    return 2 * 4 * source.numel() / ms["copy"] * 1e3, 2 * 8192**3 / ms["product"] * 1e3


def floors_ms(
    cloud: GaussianCloud, camera: Camera, rates: tuple[float, float]
) -> tuple[float, float]:
    """Forward and backward: the larger of the bytes' and the operations' time."""
    bandwidth, peak = rates
    count, features = cloud.features.shape
    inputs, images = 4 * count * (8 + features), 4 * camera.width * camera.height * (5 + features)
    alphas, channels = touched_pixels(cloud, camera), 4 + features
    # An alpha takes about 12 operations, a channel of its weight two forward and four backward.
    forward = max((inputs + images) / bandwidth, alphas * (12 + 2 * channels) / peak)
    backward = max((2 * inputs + images) / bandwidth, alphas * (24 + 4 * channels) / peak)
    return 1e3 * forward, 1e3 * backward


def render_table(plan: Plan) -> None:
    """Forward and backward of every contestant at every size, and the floors."""
    everyone, rates = contestants(), ceilings(plan)
    if plan.timed:
        print(f"\nCopy {rates[0] / 1e12:.2f} TB/s, float32 product {rates[1] / 1e12:.1f} TFLOP/s.")
    names = [f"{name} {way} ms" for way in ("forward", "backward") for name in everyone]
    table("Gaussians", "image", "channels", *names, "floor forward ms", "floor backward ms")
    camera = camera_of(*plan.size)
    for count in plan.counts:
        for channels in plan.channels:
            cloud = surface_cloud(camera, count, channels - 4).to(plan.device)
            contests = {name: Contest(b, cloud, camera) for name, b in everyone.items()}
            steps: dict[str, Callable[[], object]] = {}
            for name, contest in contests.items():
                steps[f"{name} forward ms"] = contest.forward
                steps[f"{name} backward ms"] = contest.backward
            size = f"{camera.width}x{camera.height}"
            if plan.timed:
                ms = medians_ms(steps, plan.repeats)
                cells = [ms[name] for name in names]
                row(count, size, channels, *cells, *floors_ms(cloud, camera, rates))
            else:
                for step in steps.values():
                    step()
                row(count, size, channels, *[UNTIMED] * len(names), "-", "-")


# Whole frames


@dataclass(frozen=True)
class Walked:
    """Median times of a frame, root mean square error of the positions, PSNR of the map."""

    tracking_ms: float
    mapping_ms: float
    ate_cm: float
    psnr_db: float


def walked(frames: list[Frame], device: str, backend_name: str, quick: bool) -> Walked:
    """Track and map a walk; the first frame starts the map."""
    tracker = DenseTracker(
        DenseOptions(levels=2 if quick else 4, iterations=3 if quick else 12, start="velocity"),
        backend_name=backend_name,
    )
    few = MapperOptions(iterations=1, first_iterations=1) if quick else MapperOptions()
    mapper = Mapper(few, backend_name=backend_name, device=device)
    times: dict[str, list[float]] = {"track": [], "map": []}
    squares = []
    for frame in frames:
        start = _now(device)
        if frame.index == 0:
            T_map_camera = tracker.first_pose(frame)
            assert T_map_camera is not None
        else:
            T_map_camera = tracker.track(frame, mapper.gaussians).T_map_camera
        tracked = _now(device)
        if mapper.wants(frame, T_map_camera):
            mapper.add_keyframe(frame, T_map_camera)
            times["map"].append(1e3 * (_now(device) - tracked))
        if frame.index:
            times["track"].append(1e3 * (tracked - start))
        squares.append(float(((T_map_camera - pose_of(frame.index))[:3, 3] ** 2).sum()))
    errors = []
    for frame in frames:
        shown = mapper.draw(mapper.gaussians, frame.camera, pose_of(frame.index))
        colour = shown.output.colour.clamp(0.0, 1.0).cpu().numpy()
        errors.append(float(((colour - frame.rgb) ** 2).mean()))
    psnr = -10.0 * float(np.log10(np.mean(errors)))
    ate_cm = 100.0 * float(np.sqrt(np.mean(squares)))
    return Walked(statistics.median(times["track"]), statistics.median(times["map"]), ate_cm, psnr)


def _now(device: str) -> float:
    if device == "cuda":
        torch.cuda.synchronize()
    return time.perf_counter()


def frame_table(plan: Plan) -> None:
    """Whole frames here, and on the CPU where its kernels were built."""
    table("device", "image", "track ms", "map a keyframe ms", "ATE cm", "PSNR dB")
    frames = walk(backend("cuda"), camera_of(*plan.size), plan.frames, plan.device)
    places = [(plan.device, "cuda")]
    if available_instruction_sets():
        places.append(("cpu", "native"))
    for device, name in places:
        found = walked(frames, device, name, quick=not plan.timed)
        times = (found.tracking_ms, found.mapping_ms) if plan.timed else (UNTIMED, UNTIMED)
        size = f"{plan.size[0]}x{plan.size[1]}"
        row(f"{device} ({name})", size, *times, found.ate_cm, found.psnr_db)


def compile_table(channels: tuple[int, ...], capabilities: tuple[int, ...]) -> None:
    """What every kernel uses as machine code; no GPU is asked."""
    from gpu_kernels import every_kernel  # type: ignore[import-not-found]

    from toolkit.rendering.cuda.backend import Tuning

    table("sm", "channels", "kernel", "registers", "stack bytes", "shared bytes", "tensor-core ops")
    for capability in capabilities:
        for width in channels:
            for k in every_kernel(capability, width - 4, Tuning()):
                row(capability, width, k.name, k.registers, k.stack, k.shared, k.products)


def main() -> int:
    """Print all tables."""
    parser = argparse.ArgumentParser(description="Check and time the GPU renderer.")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it all run")
    parser.add_argument("--compile-only", action="store_true", help="compile, ask no GPU")
    parser.add_argument("--millions", type=float, nargs="+", default=MILLIONS)
    parser.add_argument("--channels", type=int, nargs="+", default=CHANNELS)
    parser.add_argument("--capabilities", type=int, nargs="+", default=(90, 80))
    parser.add_argument("--repeats", type=int, default=20, help="runs behind each median")
    parser.add_argument("--frames", type=int, default=30, help="of the walk")
    given = parser.parse_args()
    if min(given.channels) < 4 or given.repeats < 1 or given.frames < 2:
        parser.error("--channels start at 4, --repeats at 1, --frames at 2")
    if given.compile_only:
        compile_table(tuple(given.channels), tuple(given.capabilities))
        return 0
    if not (given.smoke or torch.cuda.is_available()):
        parser.error("no CUDA device is there; try --smoke or --compile-only")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    counts = tuple(round(1e6 * m) for m in given.millions)
    plan = Plan(device, SIZE, counts, tuple(given.channels), given.repeats, given.frames)
    if given.smoke:
        plan = Plan(device, (24, 16), (300,), (4, 18), 1, 2)
    name = torch.cuda.get_device_name() if plan.timed else "Triton's interpreter: no timing"
    print(f"{name}; torch {torch.__version__}; medians of {plan.repeats}.")
    passed = check(plan)
    render_table(plan)
    frame_table(plan)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
