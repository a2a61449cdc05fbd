"""Threads of OpenMP: they wait as the user has chosen, and forked processes have their own."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys

import numpy as np
import pytest
import torch

from toolkit.slam.tracking.flying_pixels import without_flying_pixels


@pytest.mark.parametrize(
    ("variables", "expected"),
    [
        ({}, "2000"),
        ({"GOMP_SPINCOUNT": "7"}, "7"),
        ({"OMP_WAIT_POLICY": "active"}, "None"),
    ],
)
def test_waiting_is_limited_unless_chosen(variables: dict[str, str], expected: str) -> None:
    others = {
        name: value
        for name, value in os.environ.items()
        if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
    }
    code = "import os, toolkit; print(os.environ.get('GOMP_SPINCOUNT'))"
    done = subprocess.run(
        [sys.executable, "-c", code], env=others | variables, capture_output=True, text=True
    )
    assert done.stdout.strip() == expected, done.stderr


def compute() -> None:
    """Run an operation of torch and a kernel on two threads."""
    torch.set_num_threads(2)
    assert torch.ones(1_000_000).exp().sum() > 0
    without_flying_pixels(np.ones((240, 320), np.float32), 260.0, 1e-3)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_forked_processes_compute() -> None:
    """Without threads of its own, the child would wait for those of the parent."""
    before = torch.get_num_threads()
    compute()
    child = multiprocessing.get_context("fork").Process(target=compute)
    child.start()
    child.join(timeout=60)
    child.kill()
    assert child.exitcode == 0
    compute()
    torch.set_num_threads(before)
