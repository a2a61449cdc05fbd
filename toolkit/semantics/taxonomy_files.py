"""Files of taxonomies: YAML, which a GPU server may lack, so they are read only on demand."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from toolkit.errors import FormatError


def read_values(path: Path) -> Any:
    """What a YAML or JSON file holds.

    Raises:
        FormatError: the file is missing, is neither, or repeats a key.
    """
    try:
        # JSON is YAML; the loader that keeps duplicate keys apart finds both.
        return yaml.load(path.read_text(encoding="utf-8"), Loader=_UniqueKeys)
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"{path}: cannot be read ({error})") from error
    except yaml.YAMLError as error:
        reason = str(error).replace("\n", " ")
        raise FormatError(f"{path}: is neither YAML nor JSON ({reason})") from error
    except RecursionError:
        raise FormatError(f"{path}: is nested far too deeply for a taxonomy") from None


def yaml_of(values: Mapping[str, Any]) -> str:
    """The text of a YAML file, its keys in their order."""
    return str(
        yaml.safe_dump(
            dict(values), sort_keys=False, allow_unicode=True, width=100, default_flow_style=None
        )
    )


class _UniqueKeys(yaml.SafeLoader):
    """YAML whose mappings may not repeat a key: silently, the last one would win."""


def _construct_mapping(loader: _UniqueKeys, node: yaml.MappingNode) -> dict:
    values: dict[Any, Any] = {}
    for key_node, value_node in node.value:
        key = loader.construct_object(key_node, True)
        if not isinstance(key, str | int | float):  # true, false and numbers are refused later
            raise yaml.constructor.ConstructorError(None, None, f"{key!r} cannot be a name")
        if key in values:
            raise yaml.constructor.ConstructorError(None, None, f"'{key}' is given twice")
        values[key] = loader.construct_object(value_node, True)
    return values


_UniqueKeys.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _construct_mapping)
