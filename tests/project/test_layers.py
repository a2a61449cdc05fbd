"""The order of the layers in setup.cfg."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest


def check_layers(folder: Path) -> subprocess.CompletedProcess[str]:
    program = "import sys; from importlinter.cli import lint_imports_command as c; c()"
    return subprocess.run(
        [sys.executable, "-c", program, "--no-cache"],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture
def copied_checkout(checkout, tmp_path):
    python_only = shutil.ignore_patterns("*.so", "*.cpp", "*.hpp", "__pycache__")
    shutil.copytree(checkout / "toolkit", tmp_path / "toolkit", ignore=python_only)
    shutil.copy(checkout / "setup.cfg", tmp_path)
    return tmp_path


def test_the_layers_are_kept(checkout):
    result = check_layers(checkout)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize(
    ("module", "line", "contract"),
    [
        ("base/geometry/camera.py", "import toolkit.slam.tracking", "Each layer imports only"),
        ("io/images.py", "import open3d", "Heavy libraries"),
        ("slam/mapping/options.py", "import numpy", "Declared options"),
        # A module that the table does not name belongs nowhere.
        ("utils.py", "", "Each layer imports only"),
    ],
)
def test_a_forbidden_import_is_found(copied_checkout, module, line, contract):
    with (copied_checkout / "toolkit" / module).open("a") as file:
        file.write(f"\n{line}\n")
    result = check_layers(copied_checkout)
    assert result.returncode != 0
    assert re.search(f"{contract}.* BROKEN", result.stdout), result.stdout
