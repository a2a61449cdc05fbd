"""Lazy import of Open3D: the error message if the library cannot be loaded."""

from __future__ import annotations

import builtins
import os

import pytest

from toolkit.base.errors import DependencyError
from toolkit.base.geometry import open3d_bridge


@pytest.mark.parametrize(
    "fault",
    [
        ModuleNotFoundError("No module named 'open3d'"),
        # Raised by ctypes, with which Open3D loads its own libraries.
        OSError("libusb-1.0.so.0: cannot open shared object file"),
    ],
)
def test_import_error_names_the_command_that_installs_open3d(monkeypatch, fault):
    known = builtins.__import__

    def failing(name, *args, **kwargs):
        if name == "open3d":
            raise fault
        return known(name, *args, **kwargs)

    cores = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    monkeypatch.setattr(builtins, "__import__", failing)
    with pytest.raises(DependencyError, match=r"pip install open3d && apt-get install -y libusb"):
        open3d_bridge.open3d.__wrapped__()
    if cores is not None:
        assert os.sched_getaffinity(0) == cores
