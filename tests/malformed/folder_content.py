"""What is in a folder, to see whether a program changed it."""

from __future__ import annotations

from pathlib import Path


def content_of(folder: Path) -> dict[str, tuple[int, int]]:
    """Size and time of modification of everything below a folder, links not followed."""
    paths = [folder, *folder.rglob("*")]
    files = [path for path in paths if path.is_file()]
    states = {str(path): (path.stat().st_size, path.stat().st_mtime_ns) for path in files}
    return states | {str(path): (0, 0) for path in paths if not path.is_file()}
