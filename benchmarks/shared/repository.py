"""The version of the code: what was measured, and what has changed since."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
# The code whose results the benchmarks report. A leading "-" excludes a path.
SYSTEM = ("toolkit", "-toolkit/tools/cli")

_MEASURED = ("toolkit", "benchmarks/*.py", "setup.py")
_SOURCES = ("*.py", "*.cpp", "*.h", "*.hpp", "*.yaml")


@dataclass(frozen=True)
class CodeVersion:
    """A commit, and whether the code differed from it.

    Attributes:
        commit: abbreviated hash; empty outside a repository.
        date: of the commit, YYYY-MM-DD.
        modified: whether code had uncommitted changes.
    """

    commit: str
    date: str
    modified: bool = False


def code_version() -> CodeVersion:
    """The version of the code in the working tree."""
    head = _git("log", "-1", "--format=%h %cs", "--abbrev=10")
    if head is None:
        return CodeVersion("", "")
    commit, date = head.split()
    return CodeVersion(commit, date, bool(_git("status", "--porcelain", "--", *_MEASURED)))


def commits_since(commit: str, paths: Sequence[str]) -> int | None:
    """Number of commits after `commit` that changed one of the paths; None if it is unknown.

    Args:
        commit: a hash.
        paths: files and folders; a leading "-" excludes one.
    """
    specs = [f":(exclude){path[1:]}" if path.startswith("-") else path for path in paths]
    found = _git("rev-list", "--count", f"{commit}..HEAD", "--", *specs) if commit else None
    return None if found is None else int(found)


def source_digest() -> str:
    """Hash of the toolkit's sources as they are in the working tree."""
    digest = hashlib.sha256()
    files = {path for pattern in _SOURCES for path in (ROOT / "toolkit").rglob(pattern)}
    for path in sorted(files):
        digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _git(*arguments: str) -> str | None:
    """Output of a git command; None where git, the repository or the commit is missing."""
    command = ["git", "-C", str(ROOT), *arguments]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None
