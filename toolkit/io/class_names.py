"""`classes.json`: class names and colours of label images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from toolkit.base.errors import DatasetError
from toolkit.io.guarded.documents import read_json

_FORM = '{"void": 0, "classes": {"1": "name", ...}}'
_COLOUR_FORM = '"colours": {"1": [red, green, blue], ...}, each 0 to 255'
VOID_NAMES = ("void", "unlabeled", "unlabelled", "ignore")
_MAX_CLASS_ID = 65535
# Of as many names and colours, with room for other keys.
_MAX_BYTES = 2**24
# Maximum number of characters of a name.
MAX_NAME = 100


def name_fault(name: str) -> str | None:
    """Return what is wrong with the name of a class or group and the remedy; None for valid ones.

    Names are shown on one line of terminals, pictures and pages, and are parts of paths.
    """
    if ">" in name:
        return "'>' separates the parts of a path; leave it out"
    if name != name.strip() or not name.isprintable():
        return "remove surrounding space, line breaks and control characters"
    if len(name) > MAX_NAME:
        return f"it has {len(name)} characters; shorten it to {MAX_NAME}"
    return None


def read_class_names(path: Path) -> dict[int, str]:
    """Read class names by id from `classes.json`: {"void": 0, "classes": {"1": "name", ...}}.

    Raises:
        DatasetError: the file is missing or malformed, names no classes, id 0 has the name of a
            class, or a name is not valid.
    """
    content = _content(path)
    classes = _mapping(content, "classes", path)
    if not classes:
        raise DatasetError(
            f"{path} names no classes; add those of the label images, or remove the labels"
        )
    names: dict[int, str] = {}
    seen: dict[str, int] = {}
    for key, name in classes.items():
        number = _class_id(key, path)
        if not isinstance(name, str) or not name.strip():
            raise DatasetError(f"{path}: class {number} must have a name, got {name!r}")
        fault = name_fault(name)
        if fault is not None:
            raise DatasetError(f"{path}: class {number} is called {name[:MAX_NAME]!r}: {fault}")
        if number == 0:
            if name.casefold() not in VOID_NAMES:
                raise DatasetError(f"{path}: id 0 is void, so it cannot be '{name}'; renumber it")
            continue
        if name in seen:
            raise DatasetError(
                f"{path}: classes {seen[name]} and {number} are both called '{name}'; rename one, "
                "or give them one id"
            )
        names[number], seen[name] = name, number
    return names


def read_class_colours(path: Path) -> dict[int, tuple[int, int, int]] | None:
    """Read RGB colours by class id from `classes.json`; None if it has no key `colours`.

    Raises:
        DatasetError: the file is missing or malformed, or two classes have the same colour.
    """
    content = _content(path)
    if "colours" not in content:
        return None
    colours: dict[int, tuple[int, int, int]] = {}
    for key, colour in _mapping(content, "colours", path).items():
        number = _class_id(key, path)
        if not _is_colour(colour):
            raise DatasetError(
                f"{path}: the colour of class {number} is {colour!r}; {_COLOUR_FORM}"
            )
        red, green, blue = colour
        if (red, green, blue) in colours.values():
            raise DatasetError(f"{path}: class {number} has the colour of another class")
        colours[number] = red, green, blue
    return colours


def _content(path: Path) -> dict[str, Any]:
    try:
        content = read_json(path, max_bytes=_MAX_BYTES)
    except OSError as error:
        raise DatasetError(
            f"cannot read {path}: {error.strerror}; it must contain {_FORM}"
        ) from error
    except ValueError as error:
        raise DatasetError(f"{path} is not of the form {_FORM}: {error}") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path} is not of the form {_FORM}")
    if content.get("void", 0) != 0:
        raise DatasetError(f"{path}: void is {content['void']!r}, but must be 0; renumber it")
    return content


def _mapping(content: dict[str, Any], key: str, path: Path) -> dict[str, Any]:
    values = content.get(key)
    if not isinstance(values, dict):
        raise DatasetError(f"{path} is not of the form {_FORM}: '{key}' must be a mapping")
    return values


def _class_id(key: str, path: Path) -> int:
    # "01" would be a second key for 1.
    if not key.isdecimal() or key != str(int(key)) or int(key) > _MAX_CLASS_ID:
        raise DatasetError(
            f"{path}: '{key}' is not a class id; ids are integers from 0 to {_MAX_CLASS_ID}"
        )
    return int(key)


def _is_colour(value: object) -> bool:
    return (
        isinstance(value, list)
        and len(value) == 3
        and all(isinstance(v, int) and not isinstance(v, bool) and 0 <= v <= 255 for v in value)
    )
