"""Load the compiled kernels: one variant per instruction set, selected by CPU support.

Loading a variant that the CPU does not support terminates the interpreter, because static
constructors of the library run before any check. Variants therefore cannot be imported by name:
their file names contain a dot. A variant is loaded by path after the `base` variant, which is
compiled without extensions, has reported that CPU and operating system support it.

This module needs only the standard library.
"""

from __future__ import annotations

import functools
import importlib.util
import json
import logging
import os
import shlex
from importlib import metadata
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

from toolkit.base.errors import DependencyError
from toolkit.base.native import constants
from toolkit.base.version import __version__

INSTRUCTION_SETS = ("base", "avx2", "avx512")  # in ascending order of preference
ISA_VARIABLE = "SEMSPLAT_ISA"
_logger = logging.getLogger(__name__)
_VARIANTS = Path(__file__).parent / "variants"


def rebuild_command() -> str:
    """The command, for any folder, that installs semsplat with its kernels again."""
    origin = _origin()
    compiler = "" if origin.endswith(".whl") else "apt-get install -y g++ python3-dev && "
    return f"{compiler}pip install --force-reinstall --no-deps {origin}"


def _origin() -> str:
    """What pip is to install: this checkout, or what its record of the installation names."""
    checkout = Path(__file__).parents[3]
    if (checkout / "setup.py").is_file():
        return f"--editable {shlex.quote(str(checkout))}"
    try:
        record = metadata.distribution("semsplat").read_text("direct_url.json")  # PEP 610
    except metadata.PackageNotFoundError:
        record = None
    if record is None:  # from a package index
        return f"semsplat=={__version__}"
    values = json.loads(record)
    url, commit = values["url"], values.get("vcs_info")
    return shlex.quote(f"{commit['vcs']}+{url}@{commit['commit_id']}" if commit else url)


def _path(name: str) -> Path:
    return _VARIANTS / f"kernels.{name}{EXTENSION_SUFFIXES[0]}"


def built_instruction_sets() -> list[str]:
    """The instruction sets whose variant was compiled, whether or not this CPU supports them."""
    return [name for name in INSTRUCTION_SETS if _path(name).is_file()]


@functools.cache
def _load(name: str) -> ModuleType:
    """Load a variant without a CPU check."""
    path = _path(name)
    if not path.is_file():
        raise ImportError(f"{path} does not exist")
    spec = importlib.util.spec_from_file_location(f"toolkit.base.native.variants.{name}", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not an extension module")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    if getattr(module, "constants", None) != constants.fingerprint():
        raise DependencyError(
            f"{path} was compiled with other constants than toolkit/base/native/constants.py; "
            f"to rebuild it, run: {rebuild_command()}"
        )
    return module


def _supported_instruction_sets() -> list[str]:
    """The instruction sets of this CPU; empty if the base variant cannot be loaded."""
    try:
        return list(_load("base").supported_instruction_sets())
    except ImportError:
        return []


def load_variant(name: str) -> ModuleType:
    """Load the kernels compiled for one instruction set.

    Args:
        name: one of INSTRUCTION_SETS.

    Raises:
        DependencyError: the name is unknown, or the variant is not built, not supported by this
            CPU or cannot be loaded.
    """
    if name not in INSTRUCTION_SETS:
        raise DependencyError(
            f"instruction set {name!r} is unknown; choose one of {', '.join(INSTRUCTION_SETS)}"
        )
    built = built_instruction_sets()
    if name not in built:
        raise DependencyError(
            f"the native kernels for {name} are not built; built: {', '.join(built) or 'none'}"
        )
    try:
        supported = list(_load("base").supported_instruction_sets())
        if name not in supported:
            raise DependencyError(
                f"this CPU does not support {name}; supported: {', '.join(supported)}"
            )
        return _load(name)
    except ImportError as error:
        raise DependencyError(f"the native kernels for {name} cannot be loaded: {error}") from error


def available_instruction_sets() -> list[str]:
    """The instruction sets that are built, supported by this CPU and loadable, ascending."""
    available = []
    for name in _supported_instruction_sets():
        try:
            _load(name)
        except ImportError:
            continue
        available.append(name)
    return available


@functools.cache
def kernels() -> ModuleType | None:
    """The kernels for the best available instruction set, or None if none were built.

    The environment variable SEMSPLAT_ISA (base, avx2 or avx512) forces an instruction set.

    Raises:
        DependencyError: the forced instruction set is not available.
    """
    forced = os.environ.get(ISA_VARIABLE)
    if forced:
        try:
            return load_variant(forced)
        except DependencyError as error:
            raise DependencyError(f"{ISA_VARIABLE}={forced}: {error}") from error
    available = available_instruction_sets()
    if not available:
        _logger.warning(
            "Native kernels not found, using the slower torch code; to build them, run: %s",
            rebuild_command(),
        )
        return None
    return load_variant(available[-1])


def require_kernels() -> ModuleType:
    """The kernels for the best available instruction set.

    Raises:
        DependencyError: none were built, or the forced instruction set is not available.
    """
    module = kernels()
    if module is None:
        raise DependencyError(f"the native kernels are not built; run: {rebuild_command()}")
    return module
