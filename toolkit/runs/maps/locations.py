"""Convert the paths in settings to absolute paths."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

from toolkit.runs.settings import RunSettings


def absolute(path: Path, base: Path | None = None) -> Path:
    """Return the absolute path of a file or folder, without symbolic links in its parents.

    Args:
        base: folder that relative paths start from; the working directory by default.

    The last component stays as given: a link to a dataset may be redirected later, and the name
    of a linked file may carry its format.
    """
    path = (base or Path.cwd()) / path
    return path.parent.resolve() / path.name if path.name != ".." else path.resolve()


def with_absolute_paths(settings: RunSettings, base: Path | None = None) -> RunSettings:
    """Return the settings with absolute paths, which are valid in every working directory.

    Args:
        base: folder that relative paths start from; the working directory by default.
    """
    settings = _absolute_in(settings, base)
    # Not declared as a path, because it may be the name of a bundled taxonomy.
    taxonomy = absolute(Path(settings.semantics.taxonomy), base)
    if taxonomy.is_file():
        semantics = replace(settings.semantics, taxonomy=str(taxonomy))
        settings = replace(settings, semantics=semantics)
    return settings


def _absolute_in(value: Any, base: Path | None) -> Any:
    if isinstance(value, Path):
        return absolute(value, base)
    if isinstance(value, tuple):
        return tuple(_absolute_in(item, base) for item in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(
            value, **{f.name: _absolute_in(getattr(value, f.name), base) for f in fields(value)}
        )
    return value
