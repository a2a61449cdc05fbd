"""Paths of a run that keep their meaning in every working directory."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from toolkit.runs.settings import RunSettings


def absolute(path: Path) -> Path:
    """The absolute path of a file or folder, without symbolic links in its parent folders.

    The last component stays as given: a link to a dataset may be redirected later, and the name
    of a linked file may carry its format.
    """
    path = Path.cwd() / path
    return path.parent.resolve() / path.name if path.name != ".." else path.resolve()


def with_absolute_paths(settings: RunSettings) -> RunSettings:
    """The same settings with absolute paths, so that they hold in every working directory."""
    settings = _absolute_in(settings)
    # A name or a file, hence not declared as a path.
    taxonomy = Path(settings.semantics.taxonomy)
    if taxonomy.is_file():
        semantics = replace(settings.semantics, taxonomy=str(absolute(taxonomy)))
        settings = replace(settings, semantics=semantics)
    return settings


def _absolute_in(value: Any) -> Any:
    if isinstance(value, Path):
        return absolute(value)
    if isinstance(value, tuple):
        return tuple(_absolute_in(item) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{f.name: _absolute_in(getattr(value, f.name)) for f in fields(value)}
        )
    return value
