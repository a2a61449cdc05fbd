"""The machine that a benchmark runs on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from pathlib import Path

from toolkit.base.native import ISA_VARIABLE, available_instruction_sets, kernels

_PACKAGES = ("torch", "numpy", "open3d")


def describe_machine() -> str:
    """Processor, usable cores, memory, versions and load average, in one line.

    The load average shows whether times are reliable: it should be near zero at the start.
    """
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return f"{machine_identity()}; load {load:.1f}"


def machine_identity() -> str:
    """Processor, usable cores, memory and versions: what results may depend on, in one line."""
    versions = ", ".join(f"{name} {_version(name)}" for name in _PACKAGES)
    return (
        f"{_processor()}, {_usable_cores()} cores, {_memory_gb():.0f} GB; "
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}, {versions}"
    )


def instruction_set() -> str:
    """The instruction set of the native kernels, "none" where there are none."""
    if kernels() is None:
        return "none"
    return os.environ.get(ISA_VARIABLE) or available_instruction_sets()[-1]


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    name = next((ln.split(":", 1)[1].strip() for ln in lines if ln.startswith("model name")), "")
    flags = next((ln.split(":", 1)[1].split() for ln in lines if ln.startswith("flags")), [])
    widest = next((isa for isa in ("avx512f", "avx2") if isa in flags), "no AVX2")
    return f"{name or platform.machine()} ({widest})"


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory_gb() -> float:
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
    except (ValueError, OSError):
        return float("nan")


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "absent"


if __name__ == "__main__":
    print(describe_machine())
