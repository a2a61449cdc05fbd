"""The memory that a run may use, by its container or its machine; runs end before it is used up.

A process that exceeds the limit of its control group is killed without a word. A run therefore
compares its memory with the limit, and ends with a checkpoint and a message while there is time.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from toolkit.base.errors import MemoryLimitError

# Fraction of the limit that a run may use: a checkpoint needs memory as well.
_USABLE = 0.9
_MEMINFO, _STATUS = Path("/proc/meminfo"), Path("/proc/self/status")
_CGROUPS, _MEMBERSHIP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


class MemoryLimit:
    """Compares the memory of this process with its limit.

    Attributes:
        limit_mb: of the process; None if it is not known.
    """

    def __init__(self) -> None:
        self.limit_mb = min(_limits_mb(), default=None)

    def reached(self) -> bool:
        """Whether the process uses nearly all memory that it may."""
        return self.limit_mb is not None and _used_mb() > _USABLE * self.limit_mb

    def error(self, run: Path) -> MemoryLimitError:
        """The error that ends a run whose state has been saved."""
        return MemoryLimitError(
            f"the run uses {_used_mb():.0f} of the {self.limit_mb:.0f} MB of memory that "
            f"it may; its state is saved, so resume {run} with more memory, or start again with "
            "smaller images (--image-size) or submaps (--submaps.allocation.max-gaussians)"
        )


def _used_mb() -> float:
    """Memory of this process without that of files, which the system can free; 0 if unknown."""
    for line in _text(_STATUS).splitlines():
        if line.startswith("RssAnon:"):
            return int(line.split()[1]) * 1024 / 1e6
    return 0.0


def _limits_mb() -> Iterator[float]:
    """Limits that apply to this process: the machine's memory, and those of its control groups."""
    total = _text(_MEMINFO).partition("\n")[0].split()  # in kB
    if len(total) == 3:
        yield int(total[1]) * 1024 / 1e6
    for line in _text(_MEMBERSHIP).splitlines():
        _, controllers, place = line.split(":", 2)
        if controllers == "":
            root, name = _CGROUPS, "memory.max"
        elif "memory" in controllers.split(","):
            root, name = _CGROUPS / "memory", "memory.limit_in_bytes"
        else:
            continue
        group = root / place.lstrip("/")
        for folder in (group, *group.parents):
            if (value := _text(folder / name).strip()).isdigit():
                yield int(value) / 1e6
            if folder == root:
                break


def _text(path: Path) -> str:
    """Content of a file; empty if it cannot be read."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError:
        return ""
