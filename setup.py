"""The native kernels; everything else about the package is in setup.cfg.

The same C++ sources are compiled into one extension per instruction set;
`toolkit/base/native/loading.py` chooses among them by what the CPU supports. They are separate
libraries: in a common one the linker could keep the AVX-512 copy of a template, which
crashes on older CPUs.
"""

import copy
import os
import platform
import runpy
import shutil
import sys
from collections.abc import Iterable
from pathlib import Path

from pybind11 import get_include
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

SOURCES = Path("toolkit/base/native/src")
CONSTANTS = Path("toolkit/base/native/constants.py")
VARIANTS = "toolkit.base.native.variants"  # a folder without __init__.py, not a package

COMPILE_FLAGS = [
    "-std=c++17",
    "-O3",
    "-g0",
    "-fopenmp",
    "-fvisibility=hidden",
    "-Wall",
    "-Wextra",
    # What of -ffast-math is harmless. All of it would, at link time, switch denormal
    # numbers off for the whole process, and would delete every test for NaN.
    "-fno-math-errno",
    "-fno-trapping-math",
    "-fno-signed-zeros",
    "-fassociative-math",
    "-freciprocal-math",
]

AVX2_FLAGS = ["-mavx2", "-mfma"]
AVX512_FLAGS = [
    *AVX2_FLAGS,
    "-mavx512f",
    "-mavx512bw",
    "-mavx512vl",
    "-mavx512dq",
    "-mprefer-vector-width=512",  # else GCC stays with 256 bits
    "-Wno-uninitialized",  # false alarms from GCC 12's own headers
    "-Wno-maybe-uninitialized",
]


def instruction_sets() -> dict[str, list[str]]:
    """Compiler flags of each variant that the kind of processor can have."""
    variants: dict[str, list[str]] = {"base": []}
    # The variable is set where the compiler is one for other processors.
    processor = os.environ.get("_PYTHON_HOST_PLATFORM", platform.machine()).lower()
    if processor.endswith(("x86_64", "amd64")):
        variants |= {"avx2": AVX2_FLAGS, "avx512": AVX512_FLAGS}
    return variants


def constants() -> list[tuple[str, str]]:
    """Macros that define the constants shared with Python, and their fingerprint."""
    shared = runpy.run_path(str(CONSTANTS))
    macros = [(f"SEMSPLAT_{name}", repr(value)) for name, value in shared["values"]().items()]
    return [*macros, ("SEMSPLAT_CONSTANTS", f'"{shared["fingerprint"]()}"')]


def native_extensions() -> list[Extension]:
    """One extension per instruction set, each from all sources."""
    if os.environ.get("SEMSPLAT_NATIVE") == "0":  # install without native kernels
        return []
    sources = sorted(str(path) for path in SOURCES.rglob("*.cpp"))
    headers = sorted(str(path) for path in SOURCES.rglob("*.hpp"))
    return [
        Extension(
            f"{VARIANTS}.{name}",
            sources,
            depends=["setup.py", str(CONSTANTS), *headers],  # setup.py has the compiler flags
            include_dirs=[get_include(), str(SOURCES)],
            # The instruction set is also the module name for PYBIND11_MODULE.
            define_macros=[("SEMSPLAT_INSTRUCTION_SET", name), *constants()],
            extra_compile_args=COMPILE_FLAGS + flags,
            extra_link_args=["-fopenmp"],
            language="c++",
            optional=True,
        )
        for name, flags in instruction_sets().items()
    ]


def is_up_to_date(compiled: Path, sources: Iterable[str]) -> bool:
    """Whether a file exists and is not older than what it is compiled from."""
    if not compiled.is_file():
        return False
    return compiled.stat().st_mtime >= max(Path(source).stat().st_mtime for source in sources)


class BuildNative(build_ext):
    """Builds the variants in parallel; installation continues without a compiler."""

    def finalize_options(self) -> None:
        super().finalize_options()
        self.failures: dict[str, list[str]] = {}
        if not self.parallel:
            self.parallel = os.cpu_count()

    def get_ext_filename(self, fullname: str) -> str:
        # The dot in the stem keeps every import statement and module walker away from the
        # file: loading a variant that the CPU does not support would kill the interpreter.
        folder, name = os.path.split(super().get_ext_filename(fullname))
        return os.path.join(folder, f"kernels.{name}")

    def copy_extensions_to_source(self) -> None:
        os.makedirs(VARIANTS.replace(".", os.sep), exist_ok=True)
        super().copy_extensions_to_source()
        # Variants that an earlier revision built here could still be imported by name.
        for stale in Path("toolkit/splatting/rendering").glob("_native_*"):
            stale.unlink()

    def build_extensions(self) -> None:
        super().build_extensions()
        if self.failures:
            reasons = "; ".join(
                f"{reason} ({', '.join(names)})" for reason, names in self.failures.items()
            )
            print(
                f"semsplat: native kernels not built: {reasons}; without any, slow torch code "
                "is used instead. To build them: apt-get install -y g++ python3-dev, then install "
                "again",
                file=sys.stderr,
            )

    def build_extension(self, ext: Extension) -> None:
        # Object files have the same names in every variant: each variant gets its own folder.
        # Set on a copy, since the variants are built in threads that share this command.
        builder = copy.copy(self)
        variant = ext.name.rpartition(".")[2]
        compiled = Path(self.get_ext_filename(ext.name))
        if not self.force and is_up_to_date(compiled, [*ext.sources, *ext.depends]):
            # A wheel contains the variants of the checkout, which take a minute to compile.
            target = Path(self.get_ext_fullpath(ext.name))
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(compiled, target)
            return
        builder.build_temp = os.path.join(self.build_temp, variant)
        try:
            super(BuildNative, builder).build_extension(ext)
        except (BaseError, CCompilerError) as error:
            self.failures.setdefault(str(error), []).append(variant)


if __name__ == "__main__":
    setup(ext_modules=native_extensions(), cmdclass={"build_ext": BuildNative})
