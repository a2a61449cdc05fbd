"""The door to Open3D: what it says where the library cannot be loaded."""

from __future__ import annotations

import builtins
import os

import pytest

from toolkit.errors import DependencyError
from toolkit.geometry import open3d_bridge


@pytest.mark.parametrize(
    "fault",
    [
        ModuleNotFoundError("No module named 'open3d'"),
        # What ctypes raises, through which Open3D loads its own libraries.
        OSError("libusb-1.0.so.0: cannot open shared object file"),
    ],
)
def test_a_failure_names_the_line_that_mends_it(monkeypatch, fault):
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
