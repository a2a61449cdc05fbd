"""Checks the GPU renderer and tracker, and times them beside gsplat, the CPU and the floors.

    python -m benchmarks.gpu                            on a machine with a CUDA device
    python -m benchmarks.gpu --parts check render       some parts only
    python -m benchmarks.gpu --smoke                    anywhere: tiny, by Triton's interpreter
    python -m benchmarks.gpu --compile-only             anywhere: what each kernel uses

docs/guides/gpu.md describes the parts, each a few minutes at most. It needs torch, triton, numpy,
OpenCV and scikit-learn, for whole frames Open3D too, and nothing of this project installed; for the
comparison with the CPU it compiles the native kernels, if a compiler and pybind11 are there. gsplat
takes part where it is installed, with its own defaults but for the 0.3 square pixels by which it
widens every Gaussian.

C channels are 3 colour, 1 depth and C - 4 features; the silhouette comes with them, and the
backward pass gives all gradients and the pose's. Times are medians, of CUDA events where
kernels are timed, contestants in turn. Floors: the bytes that must move over the bandwidth of a
large copy; the operations that must be done over the rate of a large float32 matrix product.
"""

from __future__ import annotations

import argparse
import importlib
import os
import subprocess
import sys
from pathlib import Path

import torch

from benchmarks.gpu.report import Plan, row, table
from toolkit.base.native import available_instruction_sets, kernels
from toolkit.datasets.options import READERS

ROOT = Path(__file__).resolve().parents[2]
CHANNELS = (4, 18, 30, 105)
MILLIONS = (0.5, 1.0, 3.0)
SIZE = (1200, 680)
PARTS = ("check", "render", "frames", "papers", "recordings")
ON_DEMAND = ("profile",)


def compile_table(channels: tuple[int, ...], capabilities: tuple[int, ...]) -> None:
    """What every kernel uses as machine code; no GPU is asked."""
    from benchmarks.gpu.kernels import every_kernel
    from toolkit.splatting.rendering.cuda.tuning import Tuning

    columns = ("sm", "channels", "kernel", "registers", "stack bytes", "shared bytes")
    table("Kernels as machine code", *columns, "tensor-core ops")
    for capability in capabilities:
        for width in channels:
            for k in every_kernel(capability, width - 4, Tuning()):
                row(capability, width, k.name, k.registers, k.stack, k.shared, k.products)


def build_native() -> None:
    """Compile the CPU's kernels where they are not there; without a compiler, go on without."""
    if available_instruction_sets():
        return
    print("Compiling the native kernels for the comparison with the CPU.", flush=True)
    command = [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    importlib.invalidate_caches()
    kernels.cache_clear()
    if not available_instruction_sets():
        lines = (built.stderr or built.stdout).strip().splitlines() or ["no reason given"]
        print(f"Without the CPU: {lines[-1]}")


def measure(plan: Plan, parts: list[str], recordings: list[tuple[str, str]]) -> bool:
    """Run the parts in their order; whether all checks passed."""
    # Here, and not at the top, since Triton must find its mode set.
    from benchmarks.gpu import frames, profiling, render

    if set(parts) & {"check", "render"}:
        render.gsplat()  # says so if it is not there, before any table
    if plan.timed and set(parts) & {"frames", "recordings"}:
        build_native()
    passed = True
    if "check" in parts:
        # New memory is filled with NaN: what a kernel forgets to write shows.
        torch.set_deterministic_debug_mode("warn")
        passed = render.check(plan)
        passed &= frames.check_alignment(plan)
        torch.set_deterministic_debug_mode("default")
    if "render" in parts:
        render.render_table(plan)
        render.ellipsoids_table(plan)
    if "frames" in parts:
        frames.frame_table(plan)
    if "papers" in parts:
        frames.papers_table(plan)
    if "recordings" in parts and recordings:
        frames.recording_table(plan, recordings)
    if "profile" in parts:
        profiling.profile_table(plan)
    return passed


def arguments() -> argparse.Namespace:
    """What the user asked for."""
    parser = argparse.ArgumentParser(description="Check and time the GPU renderer and tracker.")
    parser.add_argument("--smoke", action="store_true", help="tiny sizes: does it all run")
    parser.add_argument("--compile-only", action="store_true", help="compile, ask no GPU")
    parser.add_argument("--parts", nargs="+", choices=PARTS + ON_DEMAND, default=PARTS)
    parser.add_argument("--millions", type=float, nargs="+", default=MILLIONS)
    parser.add_argument("--channels", type=int, nargs="+", default=CHANNELS)
    parser.add_argument("--capabilities", type=int, nargs="+", default=(90, 80))
    parser.add_argument("--repeats", type=int, default=20, help="runs behind each median")
    parser.add_argument("--frames", type=int, default=31, help="of the walk, or of a recording")
    parser.add_argument(
        "--recording",
        nargs=2,
        action="append",
        default=[],
        metavar=("KIND", "DIR"),
        help=f"a folder on disk, with its true path; kinds: {', '.join(READERS)}",
    )
    given = parser.parse_args()
    if min(given.channels) < 4 or given.repeats < 1 or given.frames < 2:
        parser.error("--channels start at 4, --repeats at 1, --frames at 2")
    if not (given.smoke or given.compile_only or torch.cuda.is_available()):
        parser.error("no CUDA device is there; try --smoke or --compile-only")
    return given


def main() -> int:
    """Print all tables."""
    given = arguments()
    channels = tuple(given.channels)
    # Triton reads the variable when it is imported, which happens below.
    if given.compile_only:
        os.environ.pop("TRITON_INTERPRET", None)
        compile_table(channels, tuple(given.capabilities))
        return 0
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if given.smoke and device == "cpu":
        os.environ["TRITON_INTERPRET"] = "1"
    counts = tuple(round(1e6 * m) for m in given.millions)
    plan = Plan(device, SIZE, counts, channels, given.repeats, given.frames)
    if given.smoke:
        plan = Plan(device, (24, 16), (300,), (4, 18), 1, 2)
    name = torch.cuda.get_device_name() if plan.timed else "Triton's interpreter: no timing"
    triton = importlib.import_module("triton")
    versions = f"torch {torch.__version__}, triton {triton.__version__}"
    print(f"{name}; {versions}; medians of {plan.repeats}.", flush=True)
    passed = measure(plan, list(given.parts), [tuple(r) for r in given.recording])
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
