"""No import and no choice of kernels executes instructions that the CPU does not support.

QEMU emulates older CPUs, so that this is tested on machines with AVX-512 as well. Only the standard
library and `toolkit.base.native` are loaded: torch takes too long to load under emulation.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from toolkit.base import native

CHECKOUT = Path(__file__).resolve().parents[2]

# Imports every extension module that an import statement could find below toolkit/, then runs one
# kernel: SSIM of an image with itself and with its negative.
PROGRAM = """
import array, importlib.util, os, pkgutil
from importlib.machinery import ExtensionFileLoader
import toolkit

names = []
for folder, _, _ in os.walk(os.path.dirname(toolkit.__file__)):
    for module in pkgutil.iter_modules([folder]):
        spec = module.module_finder.find_spec(module.name)
        if isinstance(spec.loader, ExtensionFileLoader):
            spec.loader.exec_module(importlib.util.module_from_spec(spec))
        names.append(module.name)
print("loading" in names)

from toolkit.base import native

kernels = native.require_kernels()
width, height = 37, 13
image = array.array("f", ((5 * x + 3 * y) % 7 / 7 for y in range(height) for x in range(width)))
negative = array.array("f", (1 - value for value in image))
gradient = array.array("f", bytes(4 * len(image)))
address, shape = image.buffer_info()[0], (1, height, width)
same = kernels.mean_ssim(address, address, shape, 0.0, 0)
other = kernels.mean_ssim(
    address, negative.buffer_info()[0], shape, 1.0, gradient.buffer_info()[0]
)
print(round(same, 4), other < 0, any(gradient))
print(*native.available_instruction_sets(), "->", kernels.instruction_set)
"""


def run_program(*emulator: str, **environment: str) -> subprocess.CompletedProcess[str]:
    unforced = {key: value for key, value in os.environ.items() if key != native.ISA_VARIABLE}
    return subprocess.run(
        [*emulator, sys.executable, "-c", PROGRAM],
        cwd=CHECKOUT,
        env=unforced | {"PYTHONPATH": str(CHECKOUT), "OMP_NUM_THREADS": "1"} | environment,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


@pytest.fixture(scope="module")
def qemu() -> str:
    """QEMU's user-mode emulator for x86-64, version 7.2 or later."""
    if platform.machine() not in ("x86_64", "AMD64"):
        pytest.skip("only the x86-64 kernels have several instruction sets")
    missing = set(native.INSTRUCTION_SETS) - set(native.built_instruction_sets())
    if missing:
        pytest.skip(f"native kernels not built: {', '.join(sorted(missing))}")
    for name in ("qemu-x86_64-static", "qemu-x86_64"):
        program = shutil.which(name)
        if program:
            break
    else:
        pytest.skip("QEMU is not installed: apt-get install qemu-user-static")
    printed = subprocess.run([program, "--version"], capture_output=True, text=True, check=True)
    version = re.search(r"version (\d+)\.(\d+)", printed.stdout)
    assert version is not None, printed.stdout
    if tuple(map(int, version.groups())) < (7, 2):
        pytest.skip(f"QEMU {version[1]}.{version[2]} does not emulate AVX2; 7.2 does")
    return program


@pytest.mark.parametrize(
    ("cpu", "available"), [("Nehalem", ["base"]), ("Haswell", ["base", "avx2"])]
)
def test_older_cpu_uses_its_best_supported_kernels(
    qemu: str, cpu: str, available: list[str]
) -> None:
    result = run_program(qemu, "-cpu", cpu)
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [
        "True",
        "1.0 True True",
        f"{' '.join(available)} -> {available[-1]}",
    ]


def test_forcing_an_unsupported_instruction_set_raises(qemu: str) -> None:
    result = run_program(qemu, "-cpu", "Haswell", SEMSPLAT_ISA="avx512")
    assert result.returncode == 1
    message = "SEMSPLAT_ISA=avx512: this CPU does not support avx512; supported: base, avx2"
    assert message in result.stderr.splitlines()[-1]


def test_this_cpu_uses_its_best_supported_kernels() -> None:
    available = native.available_instruction_sets()
    if not available:
        pytest.skip("the native kernels were not built")
    result = run_program()
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines()[-1] == f"{' '.join(available)} -> {available[-1]}"
