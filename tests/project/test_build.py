"""The native build without a compiler, and the continuous check."""

import os
import re
import shutil
import subprocess
import sys

import pytest

TINY_SOURCE = """
#include <pybind11/pybind11.h>
PYBIND11_MODULE(SEMSPLAT_INSTRUCTION_SET, m) {}
"""


def test_without_a_compiler_the_build_succeeds_and_says_so_in_one_line(checkout, tmp_path):
    pytest.importorskip("pybind11")
    for name in ("setup.py", "pyproject.toml"):
        shutil.copy(checkout / name, tmp_path)
    sources = tmp_path / "toolkit/base/native/src"
    sources.mkdir(parents=True)
    (sources / "tiny.cpp").write_text(TINY_SOURCE)
    shutil.copy(checkout / "toolkit/base/native/constants.py", sources.parent)
    result = subprocess.run(
        [sys.executable, "setup.py", "--quiet", "build_ext", "--inplace"],
        cwd=tmp_path,
        env=os.environ | {"CC": "no-such-compiler", "CXX": "no-such-compiler"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert result.stderr.startswith("semsplat: native kernels not built: ")
    assert re.search(r"\(.*\bbase\b.*\)", result.stderr)
    assert "apt-get install -y g++" in result.stderr
    assert result.stderr.count("\n") == 1
    assert not list(tmp_path.rglob("*.so"))


def test_a_failing_check_fails_the_continuous_check(checkout, tmp_path):
    make = tmp_path / "make"
    make.write_text('#!/bin/sh\necho "$@"\nexit 3\n')
    make.chmod(0o755)
    result = subprocess.run(
        [checkout / ".ci/run"],
        env=os.environ | {"PATH": f"{tmp_path}:{os.environ['PATH']}"},
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )
    assert result.returncode == 3
    assert result.stdout == "lint test\n"


def test_make_says_before_each_long_step_what_happens(checkout):
    planned = subprocess.run(
        ["make", "--dry-run", "--always-make", "demo"],
        cwd=checkout,
        capture_output=True,
        text=True,
        timeout=20,
        check=True,
    ).stdout.splitlines()
    for step in ("pip install", "setup.py --quiet build_ext", "semsplat make-room"):
        first = next(i for i, line in enumerate(planned) if step in line)
        assert planned[first - 1].startswith('echo "make: '), step
        assert "minute" in planned[first - 1]
