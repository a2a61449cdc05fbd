"""How the threads of OpenMP wait for each other."""

from __future__ import annotations

import os

# By default, GNU OpenMP checks 300,000 times for the other threads before a waiting thread gives
# its core away. Beside other busy processes, waiting threads then use up the time that the system
# would give to the thread that they wait for: a run beside one busy process took up to four times
# as long, instead of 1.3 times; with 8,000 checks 2.3 times. With 500 checks or none, runs on an
# idle machine take up to 15 % longer.
_CHECKS = "2000"


def limit_waiting() -> None:
    """Let waiting threads give their cores away soon, unless the user has chosen a policy.

    GNU OpenMP reads the variable when it is loaded, so this must run before torch is imported.
    """
    if "OMP_WAIT_POLICY" not in os.environ:
        os.environ.setdefault("GOMP_SPINCOUNT", _CHECKS)
