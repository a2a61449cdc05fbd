"""`semsplat doctor`: report missing packages and libraries and how to install them."""

from __future__ import annotations

import argparse
import ctypes
import importlib.metadata
import os
import platform
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.util import find_spec

from toolkit.base.errors import DependencyError, SettingsError
from toolkit.base.version import __version__

# Import name: distribution.
_REQUIRED = {
    "numpy": "numpy",
    "cv2": "opencv-python-headless",
    "PIL": "pillow",
    "sklearn": "scikit-learn",
    "faiss": "faiss-cpu",
    "gtsam": "gtsam",
    "pydantic": "pydantic",
    "tyro": "tyro",
    "yaml": "PyYAML",
    "tqdm": "tqdm",
    "filelock": "filelock",
    "jinja2": "Jinja2",
    "matplotlib": "matplotlib",
}

# Import name: distribution, purpose.
_OPTIONAL = {
    "transformers": ("transformers", "DINOv2 and segmentation models"),
    "openai": ("openai", "building a taxonomy with a language model"),
    "rosbags": ("rosbags", "bags of ROS and RealSense"),
    "lzfse": ("lzfse", "depth of Record3D"),
    "pyrealsense2": ("pyrealsense2", "RealSense cameras"),
    "rerun": ("rerun-sdk", "recordings for Rerun (--record)"),
    "ray": ("ray", "many runs on a cluster"),
    "fsspec": ("fsspec", "maps in shared storage"),
    "trimesh": ("trimesh", "meshes in glTF"),
    "pxr": ("usd-core", "splats in OpenUSD"),
    "laspy": ("'laspy[lazrs]'", "point clouds in LAS and LAZ"),
    "fastapi": ("fastapi", "semsplat serve"),
    "mcp": ("mcp", "semsplat serve --mcp"),
    "uvicorn": ("uvicorn", "semsplat serve"),
}

# Shared library that Open3D loads: Debian package.
_SYSTEM_LIBRARIES = {
    "libusb-1.0.so.0": "libusb-1.0-0",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
}


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        subject: the checked component.
        state: its version or state.
        remedy: command that fixes the problem; empty without a problem.
        needed: whether `semsplat run` needs the component.
    """

    subject: str
    state: str
    remedy: str = ""
    needed: bool = False


def main(argv: Sequence[str]) -> int:
    """Print the report.

    Returns:
        0, or 1 if a component that `semsplat run` needs is missing.
    """
    parser = argparse.ArgumentParser(prog="semsplat doctor", description=__doc__)
    _, unknown = parser.parse_known_args(list(argv))
    if unknown:
        raise SettingsError(f"doctor takes no arguments, got {' '.join(unknown)}")
    findings = list(examine())
    width = max(len(finding.subject) for finding in findings)
    for finding in findings:
        print(f"{finding.subject:<{width}}  {finding.state}")
        if finding.remedy:
            print(f"{'':<{width}}  fix it with: {finding.remedy}")
    missing = [finding.subject for finding in findings if finding.needed and finding.remedy]
    print(f"\nmissing: {', '.join(missing)}" if missing else "\nno required component is missing")
    return 1 if missing else 0


def examine() -> Iterator[Finding]:
    """Look at everything, the cheap things first."""
    yield Finding("semsplat", __version__)
    yield Finding("python", f"{platform.python_version()} ({sys.executable})")
    if find_spec("torch") is None:
        yield Finding("torch", "missing", "pip install torch", needed=True)
    else:
        yield from _compute_findings()
    yield from _open3d_findings()
    for module, distribution in _REQUIRED.items():
        yield _package(module, distribution)
    for module, (distribution, purpose) in _OPTIONAL.items():
        yield _optional_package(module, distribution, purpose)


def _compute_findings() -> Iterator[Finding]:
    import torch

    yield Finding("torch", torch.__version__)
    yield Finding("instruction set", f"{torch.backends.cpu.get_cpu_capability()} ({_processor()})")
    yield _native_kernels()
    yield _threads(torch.get_num_threads())
    yield _gpu()


def _native_kernels() -> Finding:
    from toolkit.base import native

    subject, rebuild = "native kernels", native.rebuild_command()
    forced = bool(os.environ.get(native.ISA_VARIABLE))
    built = native.built_instruction_sets()
    if not built:
        return Finding(subject, "not built: rendering uses slow torch code", rebuild)
    try:
        chosen = native.kernels()
    except DependencyError as error:
        remedy = f"unset {native.ISA_VARIABLE}" if forced else rebuild
        return Finding(subject, str(error), remedy, needed=True)
    if chosen is None:
        return Finding(subject, f"built ({', '.join(built)}), but cannot be loaded", rebuild)
    by = f" ({native.ISA_VARIABLE})" if forced else ""
    return Finding(subject, f"{chosen.instruction_set}{by}; built: {', '.join(built)}")


def _threads(torch_threads: int) -> Finding:
    cores = _usable_cores()
    set_to = os.environ.get("OMP_NUM_THREADS")
    state = f"{torch_threads} of {cores} usable cores"
    if set_to and torch_threads < cores:
        return Finding("threads", f"{state}: OMP_NUM_THREADS={set_to}", "unset OMP_NUM_THREADS")
    return Finding("threads", state)


def _gpu() -> Finding:
    import torch

    if torch.cuda.is_available():
        count = torch.cuda.device_count()
        names = ", ".join(torch.cuda.get_device_name(i) for i in range(count))
        return Finding("gpu", names)
    if shutil.which("nvidia-smi") and torch.version.cuda is None:
        return Finding(
            "gpu",
            "NVIDIA GPU, but the installed torch supports only the CPU",
            "pip uninstall -y torch && pip install torch",
        )
    return Finding("gpu", "no GPU that torch can use; computation runs on the CPU")


def _open3d_findings() -> Iterator[Finding]:
    if sys.platform == "linux":
        yield _system_libraries()
    from toolkit.base.geometry.open3d_bridge import open3d

    try:
        yield Finding("open3d", open3d().__version__)
    except (DependencyError, OSError) as error:
        yield Finding("open3d", str(error), "pip install open3d", needed=True)


def _system_libraries() -> Finding:
    subject = "system libraries"
    missing = [package for name, package in _SYSTEM_LIBRARIES.items() if not _loads(name)]
    if missing:
        remedy = f"apt-get install -y {' '.join(missing)}"
        return Finding(subject, f"missing: {', '.join(missing)}", remedy, needed=True)
    return Finding(subject, f"complete for Open3D ({', '.join(_SYSTEM_LIBRARIES.values())})")


def _package(module: str, distribution: str) -> Finding:
    if find_spec(module) is None:
        return Finding(distribution, "missing", f"pip install {distribution}", needed=True)
    return Finding(distribution, _version(distribution))


def _optional_package(module: str, distribution: str, purpose: str) -> Finding:
    if find_spec(module) is None:
        state = f"not installed; optional, for {purpose}"
        return Finding(distribution, state, f"pip install {distribution}")
    return Finding(distribution, f"{_version(distribution)}, for {purpose}")


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "present"  # from another distribution, as OpenCV has several


def _loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _usable_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            models = [line.partition(":")[2].strip() for line in file if "model name" in line]
    except OSError:
        models = []
    return models[0] if models else platform.processor() or platform.machine()
