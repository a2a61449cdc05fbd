"""How options are declared.

Options are frozen dataclasses with a docstring after each field. A stage declares its own in
`options.py` of its package, which imports neither torch nor any other heavy library. A run
composes them (`toolkit/runs/settings.py`), validates them with pydantic and stores them as YAML;
tyro parses them from the command line. This module needs the standard library alone, so that
stages can be imported where pydantic is not installed.
"""

from __future__ import annotations

import ast
import copy
import difflib
import inspect
import os
import textwrap
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, cast, get_type_hints

from toolkit.base.errors import SettingsError

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

Options = TypeVar("Options")
# Type of the errors of pydantic about unknown keys.
_UNKNOWN = "unexpected_keyword_argument"


@dataclass(frozen=True)
class Range:
    """Interval of the values that an option accepts, for `Annotated[float, Range(gt=0)]`.

    Implements the `GroupedMetadata` protocol of annotated-types, which pydantic validates.
    """

    ge: float | None = None
    """Minimum, inclusive."""
    gt: float | None = None
    """Minimum, exclusive."""
    le: float | None = None
    """Maximum, inclusive."""
    lt: float | None = None
    """Maximum, exclusive."""

    @property
    def __is_annotated_types_grouped_metadata__(self) -> bool:
        return True

    def __iter__(self) -> Iterator[Any]:
        import annotated_types

        constraints = (
            (self.ge, annotated_types.Ge),
            (self.gt, annotated_types.Gt),
            (self.le, annotated_types.Le),
            (self.lt, annotated_types.Lt),
        )
        return iter([kind(bound) for bound, kind in constraints if bound is not None])

    def __str__(self) -> str:
        low, high = self.gt if self.ge is None else self.ge, self.lt if self.le is None else self.le
        if high is None:
            return f"{'>' if self.ge is None else '>='} {low:g}"
        opening, closing = "(" if self.ge is None else "[", ")" if self.le is None else "]"
        return f"{opening}{'-inf' if low is None else f'{low:g}'}, {high:g}{closing}"


Fraction = Annotated[float, Range(ge=0, le=1)]
PositiveFloat = Annotated[float, Range(gt=0)]
NonNegativeFloat = Annotated[float, Range(ge=0)]
PositiveInt = Annotated[int, Range(ge=1)]
NonNegativeInt = Annotated[int, Range(ge=0)]


# Default of an option that must be given.
REQUIRED = MISSING


@dataclass(frozen=True)
class Option:
    """One option of a dataclass of options or of a dataclass nested in it."""

    key: str
    """Dotted path of field names, for instance "tracking.dense.max_width"."""
    type: Any
    """Type annotation, with its `Range`."""
    description: str
    """Docstring of the field."""
    default: Any = REQUIRED
    """Default value; `REQUIRED` without one."""
    group: str = ""
    """First paragraph of the docstring of the dataclass that declares the option."""

    @property
    def range(self) -> Range | None:
        """The interval of accepted values, None where any value of the type is accepted."""
        return _range_of(self.type)


def validated(
    kind: type[Options],
    content: Any,
    origin: str = "",
    shown: Callable[[str], str] = "option '{}'".format,
) -> Options:
    """Validated options; paths that start with `~` are in the home folder.

    Args:
        kind: a dataclass of options.
        content: nested dictionaries, or an instance of `kind`. Absent keys keep their defaults.
        origin: where the content comes from, for error messages.
        shown: how a message names an option, from its key.

    Raises:
        SettingsError: a key is unknown, or a value has the wrong type or is out of range.
    """
    from pydantic import ValidationError

    adapter: TypeAdapter[tuple[Options]] = _adapter(cast(Any, kind))
    try:
        return cast(Options, with_home(adapter.validate_python((content,))[0]))
    except ValidationError as error:
        message = _first_error(kind, error, shown)
    raise SettingsError(f"{origin}: {message}" if origin else message)


def accepted(
    kind: type[Options], content: dict[str, Any], origin: str = ""
) -> tuple[Options, tuple[str, ...]]:
    """Options that another version may have stored; what this version lacks is ignored.

    Args:
        kind: a dataclass of options, all of which have defaults.
        content: nested dictionaries.
        origin: where the content comes from, for error messages.

    Returns:
        The options, and the keys that are ignored: unknown ones, and those of invalid values beside
        unknown keys, as the other version may have accepted more.

    Raises:
        SettingsError: a value is invalid, and all keys are known.
    """
    from pydantic import ValidationError

    adapter: TypeAdapter[tuple[Options]] = _adapter(cast(Any, kind))
    kept, ignored = copy.deepcopy(content), list[str]()
    while True:
        try:
            adapter.validate_python((kept,))
        except ValidationError as error:
            errors = error.errors()
        else:
            break
        if not ignored and not any(found["type"] == _UNKNOWN for found in errors):
            break
        keys = [_remove(kept, found["loc"][1:]) for found in errors]
        ignored += dict.fromkeys(filter(None, keys))
        if not any(keys):
            break
    return validated(kind, kept, origin), tuple(ignored)


def _remove(content: dict[str, Any], path: Sequence[int | str]) -> str:
    """Remove what an error refers to; return its key, empty if it was removed before."""
    inner: Any = content
    for depth, name in enumerate(path):
        if name not in inner:
            return ""
        if depth + 1 < len(path) and isinstance(inner[name], dict):
            inner = inner[name]
        else:
            del inner[name]
            return ".".join(map(str, path[: depth + 1]))
    return ""


def with_home(value: Any) -> Any:
    """A value whose paths start with the home folder instead of `~`.

    Shells expand `--out ~/runs`, but not `--out=~/runs`, and YAML files are not expanded at all: a
    folder of the name `~` would be created.
    """
    if isinstance(value, Path):
        # Path.expanduser would raise where there is no such user.
        return Path(os.path.expanduser(value))
    if isinstance(value, tuple):
        return tuple(map(with_home, value))
    if isinstance(value, dict):
        return {key: with_home(item) for key, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        before = {field.name: getattr(value, field.name) for field in fields(value)}
        after = {name: with_home(item) for name, item in before.items()}
        changed = {name: item for name, item in after.items() if item != before[name]}
        return replace(value, **changed) if changed else value
    return value


def as_plain(options: Any) -> dict[str, Any]:
    """Nested dictionaries of the options, of values that YAML and JSON can represent."""
    kind: Any = type(options)
    plain: dict[str, Any] = _adapter(kind).dump_python((options,), mode="json")[0]
    return plain


@cache
def nested_options(kind: type, defaults: Any = REQUIRED) -> tuple[Option, ...]:
    """All options of a dataclass, those of nested dataclasses included, in declaration order.

    Args:
        kind: the dataclass.
        defaults: an instance of it with the default values; those declared if absent.
    """
    found: list[Option] = []
    descriptions, types = field_docstrings(kind), field_types(kind)
    group = " ".join((kind.__doc__ or "").split("\n\n")[0].split())
    for field in fields(kind):
        hint, default = types[field.name], field.default
        if defaults is not REQUIRED:
            default = getattr(defaults, field.name)
        if is_dataclass(hint):
            inner = nested_options(hint, default)  # type: ignore[arg-type]
            found += [replace(option, key=f"{field.name}.{option.key}") for option in inner]
        else:
            found.append(Option(field.name, hint, descriptions.get(field.name, ""), default, group))
    return tuple(found)


def field_types(kind: type) -> dict[str, Any]:
    """Resolved annotations of a dataclass's fields, with their metadata."""
    hints = get_type_hints(kind, include_extras=True)
    return {field.name: hints[field.name] for field in fields(kind)}


@cache
def field_docstrings(kind: type) -> dict[str, str]:
    """Docstrings of a dataclass's fields: the string literal below each, on one line."""
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if not is_dataclass(base):
            continue
        definition = ast.parse(textwrap.dedent(inspect.getsource(base))).body[0]
        assert isinstance(definition, ast.ClassDef)
        for field, below in zip(definition.body, definition.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(below, ast.Expr)
                and isinstance(below.value, ast.Constant)
            ):
                found[field.target.id] = " ".join(str(below.value.value).split())
    return found


def suggestion(kind: type, key: str, shown: Callable[[str], str]) -> str:
    """End of an error message that proposes the key most similar to an unknown one, or nothing."""
    keys = [option.key for option in nested_options(kind)]
    by_path = difflib.get_close_matches(key, keys, n=1, cutoff=0.8)
    names = {path.rpartition(".")[2]: path for path in reversed(keys)}
    by_name = difflib.get_close_matches(key.rpartition(".")[2], names, n=1, cutoff=0.8)
    similar = by_path or [names[name] for name in by_name]
    return f"; did you mean {shown(similar[0])}?" if similar else ""


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    from pydantic import ConfigDict, TypeAdapter

    # A configuration cannot be passed for a dataclass, but for a tuple, whose items inherit it.
    return TypeAdapter(
        tuple[kind],  # type: ignore[valid-type]
        config=ConfigDict(extra="forbid", allow_inf_nan=False, revalidate_instances="always"),
    )


def _first_error(kind: type, error: ValidationError, shown: Callable[[str], str]) -> str:
    """The first error in one line: key, what is wrong, value, number of further errors."""
    errors = error.errors()
    first = errors[0]
    key = ".".join(str(part) for part in first["loc"][1:])
    if first["type"] == _UNKNOWN:
        text = f"unknown {shown(key)}" + suggestion(kind, key, shown)
    else:
        reason = first["msg"][0].lower() + first["msg"][1:]
        text = f"{shown(key)}: {reason}, got {first['input']!r}"
    return text + (f" (and {len(errors) - 1} more)" if len(errors) > 1 else "")


def _range_of(hint: Any) -> Range | None:
    for part in getattr(hint, "__metadata__", ()):
        if isinstance(part, Range):
            return part
    for argument in getattr(hint, "__args__", ()):
        found = _range_of(argument)
        if found is not None:
            return found
    return None
