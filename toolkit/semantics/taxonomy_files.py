"""Read and write taxonomy files; imported on demand, because PyYAML may not be installed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from toolkit.errors import FormatError
from toolkit.io.user_files import read_text


def read_values(path: Path) -> Any:
    """Read the values of a YAML or JSON file.

    Raises:
        FormatError: the file is missing, is neither YAML nor JSON, or repeats a key.
    """
    try:
        # JSON is a subset of YAML; this loader rejects duplicate keys in both.
        return yaml.load(read_text(path), Loader=_UniqueKeys)
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: cannot be read ({error})") from error
    except yaml.YAMLError as error:
        reason = str(error).replace("\n", " ")
        raise FormatError(f"{path}: is neither YAML nor JSON ({reason})") from error
    except RecursionError:
        raise FormatError(f"{path}: is nested far too deeply for a taxonomy") from None


def yaml_of(values: Mapping[str, Any]) -> str:
    """Return the text of a YAML file, with the keys in their order."""
    return str(
        yaml.safe_dump(
            dict(values), sort_keys=False, allow_unicode=True, width=100, default_flow_style=None
        )
    )


class _UniqueKeys(yaml.SafeLoader):
    """A YAML loader that rejects duplicate keys; the default one keeps the last value."""


def _construct_mapping(loader: _UniqueKeys, node: yaml.MappingNode) -> dict:
    values: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, True)
        if not isinstance(key, str | int | float):  # booleans and numbers are rejected later
            raise yaml.constructor.ConstructorError(None, None, f"{key!r} cannot be a name")
        if key in values:
            raise yaml.constructor.ConstructorError(None, None, f"'{key}' is given twice")
        values[key] = loader.construct_object(value_node, True)
    return values


_UniqueKeys.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
