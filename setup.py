"""The native kernels; everything else about the package is in setup.cfg.

The same C++ sources become one extension per instruction set, chosen at import by
what the processor can do. They are compiled apart and never mixed in one library:
the linker may keep the AVX-512 copy of a template, and older processors die on it.
"""

import copy
import os
import platform
import sys
from pathlib import Path

from pybind11 import get_include
from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext
from setuptools.errors import BaseError, CCompilerError

SOURCES = Path("toolkit/rendering/native_src")

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
    "-Wno-maybe-uninitialized",  # false alarms out of GCC 12's own headers
]


def instruction_sets() -> dict[str, list[str]]:
    """Compiler flags of each variant that this kind of processor can have."""
    variants: dict[str, list[str]] = {"base": []}
    if platform.machine().lower() in ("x86_64", "amd64"):
        variants |= {"avx2": AVX2_FLAGS, "avx512": AVX512_FLAGS}
    return variants


def native_extensions() -> list[Extension]:
    """One extension per instruction set, from all sources of the folder."""
    if os.environ.get("SEMSPLAT_NATIVE") == "0":  # for whoever wants only Python
        return []
    sources = sorted(str(path) for path in SOURCES.glob("*.cpp"))
    headers = sorted(str(path) for path in SOURCES.glob("*.hpp"))
    return [
        Extension(
            f"toolkit.rendering._native_{name}",
            sources,
            depends=["setup.py", *headers],  # its flags as much as the headers
            include_dirs=[get_include()],
            # The name that PYBIND11_MODULE must give this variant.
            define_macros=[("SEMSPLAT_MODULE", f"_native_{name}")],
            extra_compile_args=COMPILE_FLAGS + flags,
            extra_link_args=["-fopenmp"],
            language="c++",
            optional=True,
        )
        for name, flags in instruction_sets().items()
    ]


class BuildNative(build_ext):
    """Builds the variants side by side; without a compiler the install goes on."""

    def finalize_options(self) -> None:
        super().finalize_options()
        self.failures: dict[str, list[str]] = {}
        if not self.parallel:
            self.parallel = os.cpu_count()

    def build_extensions(self) -> None:
        super().build_extensions()
        if self.failures:
            reasons = "; ".join(
                f"{reason} ({', '.join(names)})" for reason, names in self.failures.items()
            )
            print(
                f"semsplat: native kernels missing: {reasons}; without any, a slow plain-torch "
                "path takes over. Mend it with: apt-get install -y g++ python3-dev, then install "
                "again",
                file=sys.stderr,
            )

    def build_extension(self, ext: Extension) -> None:
        # Objects have the same names in every variant: each gets a folder of its own.
        # On a copy, since the variants are built in threads that share this command.
        builder = copy.copy(self)
        variant = ext.name.rpartition(".")[2]
        builder.build_temp = os.path.join(self.build_temp, variant)
        try:
            super(BuildNative, builder).build_extension(ext)
        except (BaseError, CCompilerError) as error:
            self.failures.setdefault(str(error), []).append(variant)


setup(ext_modules=native_extensions(), cmdclass={"build_ext": BuildNative})
