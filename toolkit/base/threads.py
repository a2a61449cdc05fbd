"""Threads of libraries: those of OpenMP while they wait and at a fork, and how many BLAS uses."""

from __future__ import annotations

import functools
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# By default, GNU OpenMP checks 300,000 times for the other threads before a waiting thread gives
# its core away. Beside other busy processes, waiting threads then use up the time that the system
# would give to the thread that they wait for: a run beside one busy process took up to four times
# as long, instead of 1.3 times; with 8,000 checks 2.3 times. With 500 checks or none, runs on an
# idle machine take up to 15 % longer.
_CHECKS = "2000"
_PAUSE_SOFT = 1  # omp_pause_soft of OpenMP 5.0: threads end, settings remain
# Packages that bring a BLAS of their own, besides NumPy's.
_WITH_BLAS = ("cv2", "faiss", "scipy.linalg")


def limit_waiting() -> None:
    """Let waiting threads give their cores away soon, unless the user has chosen a policy.

    GNU OpenMP reads the variable when it is loaded, so this must run before torch is imported.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _CHECKS)


def allow_forks() -> None:
    """Let forked processes compute, also after this one has computed on several threads.

    A forked process has one thread only, but GNU OpenMP would wait in it forever for the threads
    of its parent. They end before a fork, and start again on their next use in either process.
    """
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(before=_end_openmp_threads)


def _end_openmp_threads() -> None:
    """End the threads that GNU OpenMP keeps for the calling thread; other libraries handle forks.

    Packages bring copies of the library, each with threads of its own.
    """
    if "torch" not in sys.modules:
        return
    from threadpoolctl import ThreadpoolController

    for library in ThreadpoolController().lib_controllers:
        if library.prefix == "libgomp":
            library.dynlib.omp_pause_resource_all(_PAUSE_SOFT)


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """Let BLAS use a single thread in a block, or in a decorated function.

    After each product of large matrices, the threads of OpenBLAS wait for the next one in a loop,
    for about 30 ms, on the cores that the kernels need. On two cores, four such products per
    keyframe made tracking and mapping 30 % slower. The products themselves take less than 1 ms.
    """
    present = tuple(name for name in _WITH_BLAS if name in sys.modules)
    with _libraries(present).limit(limits=1, user_api="blas"):
        yield


@functools.cache
def _libraries(_present: tuple[str, ...]) -> Any:
    """The thread pools of NumPy and of the packages that are present.

    Finding them takes 4 ms, so it is repeated only when another package was imported.
    """
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
