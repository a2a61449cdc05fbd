"""The wheel: installed outside the checkout, it has all files that programs read."""

import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest


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
    """A wheel of the tracked files as they are here, without native kernels."""
    folder = tmp_path_factory.mktemp("wheel")
    for name in tracked_files(checkout):
        if (checkout / name).is_file():  # not those deleted since the last commit
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(checkout / name, folder / "source" / name)
    pip = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    environment = os.environ | {"SEMSPLAT_NATIVE": "0"}
    call(*pip, "--wheel-dir", folder, folder / "source", env=environment)
    (path,) = folder.glob("*.whl")
    return path


def test_the_wheel_contains_every_file_but_the_sources_of_the_kernels(checkout, wheel):
    expected = {
        name
        for name in tracked_files(checkout)
        if name.startswith("toolkit/") and not name.startswith("toolkit/base/native/src/")
    }
    assert expected <= set(zipfile.ZipFile(wheel).namelist())


def test_an_installed_program_writes_a_page_outside_the_checkout(checkout, wheel, tmp_path):
    environment = tmp_path / "environment"
    call(sys.executable, "-m", "venv", "--without-pip", environment)
    python = environment / "bin/python"
    call(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", wheel)
    # The libraries of this environment, but not its editable installation, which is in a .pth file.
    libraries = sysconfig.get_paths()["purelib"]
    known = os.environ | {"PYTHONPATH": libraries, "OMP_NUM_THREADS": "1"}
    where = call(python, "-c", "import toolkit; print(toolkit.__file__)", cwd=tmp_path, env=known)
    assert where.startswith(str(environment))
    # Compiling them again takes a minute, and running without them too.
    kernels = Path("base/native/variants")
    if (checkout / "toolkit" / kernels).is_dir():
        shutil.copytree(checkout / "toolkit" / kernels, Path(where).parent / kernels)
    program, room = environment / "bin/semsplat", ["--image-size", "64", "48", "--frames", "3"]
    call(program, "make-room", "--out", "room", *room, cwd=tmp_path, env=known)
    source = ["--dataset.kind", "synthetic", "--dataset.path", "room"]
    call(program, "run", *source, "--out", "run", cwd=tmp_path, env=known)
    call(program, "export", "run", "--to", "viewer.html", cwd=tmp_path, env=known)
    assert (tmp_path / "viewer.html").stat().st_size > 10_000
