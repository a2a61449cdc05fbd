"""JSON and YAML: depth, keys, numbers and characters are checked."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Hashable
from functools import cache
from typing import Any

from toolkit.io.guarded.content import DamagedError, PathLike, damage
from toolkit.io.user_files import read_text

_MAX_JSON, _MAX_YAML = 2**28, 2**22
# Characters that may separate values of YAML, which takes 30 us for each.
_SEPARATORS, _MAX_SEPARATORS = ",:-?[{\n", 300_000
# Python reads numbers of any length, which no file needs, and which cannot be converted.
_MAX_DIGITS = 40
_LONG = re.compile(rf"\d{{{_MAX_DIGITS}}}\d")
# Containers within each other, and values of a YAML file once its aliases are replaced.
_MAX_DEPTH, _MAX_VALUES = 100, 1_000_000
# Numbers are those of YAML 1.1, whose texts are written without quotation marks only if they are no
# numbers, without those to the base of 60. The key that merges another mapping.
_INTEGER = re.compile(r"[-+]?(0[0-7]*|[1-9][0-9]*|0x[0-9a-fA-F]+)\Z")
_FLOAT = re.compile(
    r"([-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN))\Z"
)
_MERGE = "tag:yaml.org,2002:merge"


def read_json(path: PathLike, any_characters: bool = False, max_bytes: int = _MAX_JSON) -> Any:
    """Read a JSON file.

    Args:
        any_characters: as of `parse_json`.
        max_bytes: limit of its size.

    Raises:
        OSError: it cannot be read.
        DamagedError: as of `parse_json`; it is too large, or not UTF-8.
    """
    with damage():
        return parse_json(read_text(path, max_bytes), any_characters=any_characters)


def parse_json(
    text: str | bytes,
    constant: Callable[[str], Any] | None = None,
    any_characters: bool = False,
) -> Any:
    """Parse JSON.

    Args:
        constant: called with NaN, Infinity and -Infinity; by default they are numbers.
        any_characters: texts may contain NUL and halves of surrogate pairs, as answers of language
            models that end within a character do.

    Raises:
        DamagedError: it is no JSON, nests too deeply, gives a key twice, or contains a number or a
            character that nothing can use.
    """
    with damage():
        if isinstance(text, bytes):
            text = text.decode("utf-8-sig")
        # A function of our own for each number takes twice as long.
        integer = _integer if _LONG.search(text) else None
        values = json.loads(
            text, object_pairs_hook=_unique, parse_int=integer, parse_constant=constant
        )
        _check_values(values, any_characters=any_characters)
        return values


def read_yaml(path: PathLike) -> Any:
    """Read a YAML file.

    Raises:
        OSError: it cannot be read.
        DamagedError: as of `parse_yaml`; it is too large, or not UTF-8.
    """
    with damage():
        return parse_yaml(read_text(path, _MAX_YAML))


def parse_yaml(text: str) -> Any:
    """Parse YAML. A number is what people read: 1:30 is a text, and 040 is 40.

    Raises:
        DamagedError: as of `parse_json`.
    """
    import yaml  # only some layouts need it, so it may be missing on a GPU server

    if sum(map(text.count, _SEPARATORS)) > _MAX_SEPARATORS:
        raise DamagedError(f"it may have more than {_MAX_SEPARATORS:,} values")
    with damage():
        values = yaml.load(text, Loader=_yaml_loader())
        _check_values(values, _MAX_VALUES)
        return values


@cache
def _yaml_loader() -> Any:
    """A loader of plain values: decimal numbers, no dates, and each key once."""
    import yaml

    class Loader(yaml.SafeLoader):
        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
            own = [key for key, _ in node.value if key.tag != _MERGE]
            _check_unique([self.construct_object(key, deep=True) for key in own])
            return super().construct_mapping(node, deep)

        def construct_yaml_int(self, node: Any) -> int:
            text = str(self.construct_scalar(node))
            return int(text, 16) if "x" in text else _integer(text)

    replaced = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float", "tag:yaml.org,2002:timestamp")
    Loader.yaml_implicit_resolvers = {
        first: [(tag, pattern) for tag, pattern in resolvers if tag not in replaced]
        for first, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    for tag, pattern in zip(replaced, (_INTEGER, _FLOAT), strict=False):
        Loader.add_implicit_resolver(tag, pattern, list("-+.0123456789"))
    Loader.add_constructor(replaced[0], Loader.construct_yaml_int)
    return Loader


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object; of a key that occurs twice, `json` keeps the last value."""
    made = dict(pairs)
    if len(made) < len(pairs):
        _check_unique([key for key, _ in pairs])
    return made


def _check_unique(keys: list[Any]) -> None:
    seen = set()
    for key in keys:
        if not isinstance(key, Hashable):
            raise DamagedError(f"{key!r} cannot be a key")
        if key in seen:
            raise DamagedError(f"the key {key!r} is given twice")
        seen.add(key)


def _integer(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise DamagedError(f"a number has {len(digits)} digits")
    return int(digits)


def _check_values(values: Any, max_values: float = math.inf, any_characters: bool = False) -> None:
    """Check the depth, the number and the characters of nested values."""
    left, count = [(values, 0)], 0
    while left:
        value, depth = left.pop()
        if depth > _MAX_DEPTH:
            raise DamagedError(f"it nests more than {_MAX_DEPTH} values in each other")
        inner = [*value, *value.values()] if isinstance(value, dict) else value
        if isinstance(inner, str):
            if not any_characters:
                _check_characters(inner)
        elif isinstance(inner, list):
            count += len(inner)
            if count > max_values:
                raise DamagedError(f"it has more than {max_values:,} values")
            left += [(each, depth + 1) for each in inner if isinstance(each, (str, list, dict))]


def _check_characters(text: str) -> None:
    """Check that a text can be written, and be a path."""
    if "\0" in text:
        raise DamagedError("a text contains the character NUL")
    if not text.isascii():
        try:
            text.encode()
        except UnicodeEncodeError as error:
            raise DamagedError("a text contains half of a surrogate pair") from error
