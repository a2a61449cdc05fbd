"""The kernels give the same results on AArch64 and when Clang compiles them, without OpenMP.

A program without Python runs all kernels (`kernels_program.cpp`). It is compiled for each target;
what this processor cannot execute runs under QEMU. Clang stands in for the compiler of macOS.
"""

from __future__ import annotations

import hashlib
import platform
import runpy
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from toolkit.base import native
from toolkit.base.native import constants

CHECKOUT = Path(__file__).resolve().parents[2]
SOURCES = CHECKOUT / "toolkit/base/native/src"
PROGRAM = Path(__file__).with_name("kernels_program.cpp")
X86 = platform.machine().lower() in ("x86_64", "amd64")


@dataclass(frozen=True)
class Target:
    """A way to compile and run the program."""

    compiler: str
    flags: tuple[str, ...] = ()
    instruction_set: str = ""  # that this processor must support
    emulator: tuple[str, ...] = ()


SETUP = runpy.run_path(str(CHECKOUT / "setup.py"), run_name="setup")
OPENMP, STATIC = ("-fopenmp",), ("-static",)
TARGETS = {
    "aarch64": Target(
        "aarch64-linux-gnu-g++", (*OPENMP, *STATIC), emulator=("qemu-aarch64-static",)
    ),
    "clang": Target("clang++"),
    "clang-avx2": Target("clang++", tuple(SETUP["AVX2_FLAGS"]), "avx2"),
}


def compiled(target: Target, cache: Path) -> Path:
    """The compiled program; each source is compiled with the flags of an installation.

    It is kept in the cache of pytest, because compiling takes most of the time, and replaced when
    a source, a flag or the compiler changes.
    """
    macros = [f"-DSEMSPLAT_{name}={value!r}" for name, value in constants.values().items()]
    flags = [flag for flag in SETUP["COMPILE_FLAGS"] if flag not in OPENMP]
    sources = [p for p in sorted(SOURCES.rglob("*.cpp")) if p.parent.name != "bindings"]
    command = [target.compiler, *flags, "-Werror", *target.flags, *macros, f"-I{SOURCES}", "-o"]
    version = subprocess.run([target.compiler, "--version"], capture_output=True, check=True).stdout
    contents = [path.read_bytes() for path in sorted(SOURCES.rglob("*.?pp"))]
    parts = (repr(command).encode(), version, PROGRAM.read_bytes(), *contents)
    name = f"{target.compiler}{''.join(target.flags)}-"
    program = cache / (name + hashlib.sha256(b"\0".join(parts)).hexdigest())
    if not program.exists():
        for old in cache.glob(f"{name}*"):
            old.unlink()
        built = subprocess.run(
            [*command, f"{program}.new", PROGRAM, *sources], capture_output=True, text=True
        )
        assert built.returncode == 0, built.stderr
        Path(f"{program}.new").rename(program)
    return program


def outputs(target: Target, cache: Path) -> dict[str, np.ndarray]:
    """Values that the program printed, by the names of the kernels' outputs."""
    for program in (target.compiler, *target.emulator):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    if target.instruction_set not in ("", *native.available_instruction_sets()):
        pytest.skip(f"this CPU does not support {target.instruction_set}")
    run = [*target.emulator, compiled(target, cache)]
    printed = subprocess.run(run, capture_output=True, text=True, check=True).stdout
    lines = [line.split() for line in printed.splitlines()]
    return {name: np.array(values, float) for name, *values in lines}


@pytest.fixture(scope="module")
def cache(pytestconfig, tmp_path_factory) -> Path:
    kept = getattr(pytestconfig, "cache", None)  # without it under -p no:cacheprovider
    return kept.mkdir("kernels") if kept else tmp_path_factory.mktemp("kernels")


@pytest.fixture(scope="module")
def reference(cache) -> dict[str, np.ndarray]:
    """Outputs of the baseline kernels of this processor."""
    return outputs(Target("g++", OPENMP), cache)


@pytest.mark.skipif(not X86, reason="the reference is the x86-64 baseline")
@pytest.mark.parametrize("name", TARGETS)
def test_kernels_agree_with_the_baseline(name: str, reference, cache) -> None:
    found = outputs(TARGETS[name], cache)
    assert found.keys() == reference.keys()
    # Rounding decides whether a pixel near the alpha threshold counts, which changes sums by more
    # than rounding itself.
    for output, expected in reference.items():
        scale = np.sqrt(expected[1])  # the root of the sum of squares
        np.testing.assert_allclose(
            found[output][2:], expected[2:], rtol=1e-3, atol=1e-3 * scale, err_msg=output
        )
        np.testing.assert_allclose(found[output][1], expected[1], rtol=2e-3, err_msg=output)
