"""`benchmarks.gpu` without a GPU: it runs in the interpreter, and its kernels compile."""

import importlib.util
from pathlib import Path

import pytest
import torch

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="triton is not installed"
)


@needs_triton
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU to run it on")
def test_it_runs_through_the_interpreter_and_times_nothing(run_python):
    result = run_python("-m", "benchmarks.gpu", "--smoke")
    assert result.returncode == 0, result.stdout + result.stderr
    assert result.stdout.count("| ok |") == 5
    assert "| 300 | 4 | interpreter | interpreter | interpreter | interpreter |" in result.stdout
    assert "| 300 | 24x16 | 18 | interpreter | interpreter" in result.stdout
    assert "| cpu (cuda) | 24x16 | 26 | interpreter | interpreter |" in result.stdout
    assert "| one-hot | 26 | interpreter |" in result.stdout


def has_ptxas() -> bool:
    spec = importlib.util.find_spec("triton")
    if spec is None or spec.origin is None:
        return False
    return (Path(spec.origin).parent / "backends/nvidia/bin/ptxas").exists()


@pytest.mark.skipif(not has_ptxas(), reason="triton brings no ptxas here")
def test_every_kernel_compiles_for_a_gpu_that_is_not_there(run_python):
    """What the interpreter accepts is more than what compiles."""
    arguments = ("--compile-only", "--channels", "30", "--capabilities", "90")
    result = run_python("-m", "benchmarks.gpu", *arguments)
    assert result.returncode == 0, result.stderr
    rows = [line.split("|") for line in result.stdout.splitlines() if line.startswith("| 90")]
    used = {cells[3].strip(): [int(c) for c in cells[4:8]] for cells in rows}
    assert len(used) == 11
    for shape in ("", ", ellipsoids"):
        composite, differentiate = used[f"composite{shape}"], used[f"differentiate{shape}"]
        assert composite[1] == differentiate[1] == 0  # nothing spilled
        assert composite[3] > 0 and differentiate[3] > 0  # on tensor cores
