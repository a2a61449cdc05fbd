"""The wheel: installed without checkout and compiler, it has kernels and all files of programs."""

import email
import os
import re
import shlex
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from toolkit.base import native
from toolkit.base.version import __version__

NATIVE = "toolkit/base/native/variants"
VARIANTS = [f"kernels.{name}{EXTENSION_SUFFIXES[0]}" for name in native.built_instruction_sets()]
# A folder without programs, and a compiler that does not exist.
WITHOUT_COMPILER = {"PATH": os.devnull, "CC": "no-such-compiler", "CXX": "no-such-compiler"}


def call(*words: str | Path, **keywords) -> str:
    result = subprocess.run(
        words, capture_output=True, text=True, timeout=300, check=False, **keywords
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


def tracked_files(checkout: Path) -> list[str]:
    if not (checkout / ".git").exists():
        pytest.skip("not a clone")
    return call("git", "ls-files", cwd=checkout).splitlines()


@pytest.fixture(scope="module")
def wheel(checkout, tmp_path_factory) -> Path:
    """A wheel of the tracked files as they are here, with the kernels that are compiled here.

    It is built as by `make wheel`, except that nothing is compiled.
    """
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    for name in tracked_files(checkout):
        if (checkout / name).is_file():  # not those deleted since the last commit
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(checkout / name, source / name)
    if VARIANTS:
        # Last, since a variant that is older than its sources would be compiled again.
        shutil.copytree(checkout / NATIVE, source / NATIVE, copy_function=shutil.copy)
    native = {} if VARIANTS else {"SEMSPLAT_NATIVE": "0"}
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    environment = os.environ | native | WITHOUT_COMPILER
    call(*pip, "--wheel-dir", folder, source, env=environment)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def repaired(checkout, wheel) -> Path:
    """The wheel with the libraries of its kernels; the wheel itself where nothing can repair it."""
    tools = checkout / ".stamps/tools/bin"
    if not VARIANTS or not (tools / "auditwheel").exists():
        return wheel
    path = os.environ | {"PATH": f"{tools}:{os.environ['PATH']}"}
    call(tools / "auditwheel", "repair", "--wheel-dir", wheel.parent / "dist", wheel, env=path)
    (found,) = (wheel.parent / "dist").glob("*.whl")
    assert "-manylinux_" in found.name
    return found


def test_the_wheel_contains_every_file_but_the_sources_of_the_kernels(checkout, wheel):
    expected = {
        name
        for name in tracked_files(checkout)
        if name.startswith("toolkit/") and not name.startswith("toolkit/base/native/src/")
    }
    expected |= {f"{NATIVE}/{variant}" for variant in VARIANTS}
    assert expected <= set(zipfile.ZipFile(wheel).namelist())


def test_the_metadata_state_what_the_wheel_is_for(checkout, wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
        metadata = email.message_from_bytes(archive.read(name))
    assert metadata["Name"] == "semsplat" and metadata["Version"] == __version__
    assert metadata["Description-Content-Type"] == "text/markdown"
    limits = SpecifierSet(metadata["Requires-Python"])
    minors = [minor for minor in range(20) if f"3.{minor}" in limits]
    stated = [c for c in metadata.get_all("Classifier") if re.search(r":: 3\.\d+$", c)]
    assert stated == [f"Programming Language :: Python :: 3.{minor}" for minor in minors]
    assert "Home-page" not in metadata  # there is no public address
    if VARIANTS:
        assert sysconfig.get_config_var("py_version_nodot") in wheel.name.split("-")[2]


@pytest.fixture(scope="module")
def installed(repaired, tmp_path_factory) -> tuple[Path, dict[str, str]]:
    """The folder of the programs of an empty environment with the wheel, and how to call them."""
    folder = tmp_path_factory.mktemp("installed")
    environment = folder / "environment"
    call(sys.executable, "-m", "venv", "--without-pip", environment)
    python = environment / "bin/python"
    pip = [sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps"]
    # A checkout in PYTHONPATH would count as an installation.
    call(*pip, repaired, env=os.environ | WITHOUT_COMPILER | {"PYTHONPATH": ""})
    # The libraries of this environment, but not its editable installation, which is in a .pth file.
    libraries = sysconfig.get_paths()["purelib"]
    known = os.environ | WITHOUT_COMPILER | {"PYTHONPATH": libraries, "OMP_NUM_THREADS": "1"}
    where = call(python, "-c", "import toolkit; print(toolkit.__file__)", cwd=folder, env=known)
    assert where.startswith(str(environment))
    return environment / "bin", known


def test_the_doctor_finds_the_kernels_of_the_wheel(installed, tmp_path):
    if not VARIANTS:
        pytest.skip("the native kernels are not built")
    programs, known = installed
    report = call(programs / "semsplat", "doctor", cwd=tmp_path, env=known)
    (line,) = [line for line in report.splitlines() if line.startswith("native kernels ")]
    assert all(variant.split(".")[1] in line for variant in VARIANTS), line


def test_the_remedy_of_the_doctor_installs_the_wheel_again(installed, repaired, tmp_path):
    programs, known = installed
    # The record of the wheel's installation must be found before that of this environment.
    without_kernels = """
import os, sys
from pathlib import Path
sys.path.append(os.environ["LIBRARIES"])
from toolkit.base.native import loading
from toolkit.tools.cli import doctor
loading._VARIANTS = Path("none")
doctor.main([])
"""
    last = known | {"PYTHONPATH": "", "LIBRARIES": known["PYTHONPATH"]}
    report = call(programs / "python", "-c", without_kernels, cwd=tmp_path, env=last)
    (remedy,) = re.findall(r"^native kernels +not built.*\n +fix it with: (pip .*)$", report, re.M)
    assert remedy.endswith(f" {repaired.as_uri()}")
    pip = [sys.executable, "-m", "pip", "--python", programs / "python"]
    call(*pip, "--quiet", *shlex.split(remedy)[1:], cwd=tmp_path, env=os.environ)


def test_an_installed_program_writes_a_page_outside_the_checkout(
    installed, tiny_recording, tmp_path
):
    programs, known = installed
    program = programs / "semsplat"
    source = ["--dataset.kind", "folder", "--dataset.path", tiny_recording, "--max-frames", "3"]
    call(program, "run", *source, "--out", "run", cwd=tmp_path, env=known)
    call(program, "export", "run", "--to", "viewer.html", cwd=tmp_path, env=known)
    assert (tmp_path / "viewer.html").stat().st_size > 10_000
