"""Read and write taxonomy files; imported on demand, because PyYAML may not be installed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from toolkit.base.errors import FormatError
from toolkit.io.guarded.documents import read_json, read_yaml


def read_values(path: Path) -> Any:
    """Read the values of a YAML or JSON file.

    Raises:
        FormatError: the file is missing, is neither YAML nor JSON, or repeats a key.
    """
    try:
        return read_json(path) if path.suffix.lower() == ".json" else read_yaml(path)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read ({error})") from error
    except ValueError as error:
        raise FormatError(f"{path}: is neither YAML nor JSON ({error})") from error


def yaml_of(values: Mapping[str, Any]) -> str:
    """Return the text of a YAML file, with the keys in their order."""
    return str(
        yaml.safe_dump(
            dict(values), sort_keys=False, allow_unicode=True, width=100, default_flow_style=None
        )
    )
