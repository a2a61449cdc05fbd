"""Memory of large images is reused."""

import subprocess
import sys

import pytest

PROGRAM = """
import resource
import sys

import numpy as np

from toolkit.runs.allocator import reuse_freed_memory

if sys.argv[1] == "reused":
    reuse_freed_memory()
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    np.ones(25_000_000, np.float32)
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc only")
def test_large_arrays_do_not_fault_again():
    def faults(mode: str) -> int:
        command = [sys.executable, "-c", PROGRAM, mode]
        return int(subprocess.run(command, stdout=subprocess.PIPE, check=True).stdout)

    default, reused = faults("default"), faults("reused")
    if default < 100:
        pytest.skip("the C library reuses large blocks by itself")
    assert reused < 0.1 * default
