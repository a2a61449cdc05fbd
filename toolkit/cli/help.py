"""Help pages of the jobs, made from the declared options.

The layout is argparse's. tyro parses the same declarations, but draws boxes of three times the
height.
"""

from __future__ import annotations

import argparse
import functools
import re
import shutil
import types
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

from tyro.conf import Positional

from toolkit.options import REQUIRED, Option, nested_options

FLAGS = frozenset(("-h", "--help", "--help-all"))

# Keys of the options that `--help` shows, by group; `--help-all` shows all. Jobs without an entry
# have few options and always show all.
COMMON: Mapping[str, Mapping[str, Sequence[str]]] = {
    "run": {
        "input": (
            "dataset.kind",
            "dataset.path",
            "image_size",
            "max_frames",
            "hold_out",
            "poses",
            "map",
        ),
        "output": ("out", "resume", "config"),
        "quality and speed": (
            "mapping.iterations",
            "denoise",
            "device",
            "seed",
        ),
        "semantics": (
            "semantics.segmenter.kind",
            "semantics.taxonomy",
            "semantics.ignore",
            "semantics.code.kind",
        ),
        "submaps and loops": ("submaps.use", "submaps.memory_mb", "loops.use"),
    },
    "register": {"options": ("run_a", "run_b", "out", "pairs", "registration.kind")},
}

_NAMES = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}


def help_page(kind: type, job: str, everything: bool = False) -> str:
    """The help page of a job.

    Args:
        kind: dataclass of the job's arguments.
        job: its name.
        everything: show all options, also of a job with a short page.
    """
    options = {option.key: option for option in nested_options(kind)}
    common = COMMON.get(job)
    groups = _by_prefix(options) if everything or common is None else common
    required = [o for o in options.values() if o.default is REQUIRED or _positional(o)]
    usage = " ".join(["semsplat", job, *map(_usage, required), "[OPTIONS]"])
    epilogue = None
    if common is not None and not everything:
        shown = sum(len(keys) for keys in common.values())
        epilogue = f"{shown} of {len(options)} options; `semsplat {job} --help-all` lists all."
    description = " ".join((kind.__doc__ or "").split())
    width = min(shutil.get_terminal_size().columns, 100)
    parser = argparse.ArgumentParser(
        usage=usage,
        description=description.replace("%", "%%"),
        epilog=epilogue,
        add_help=False,
        formatter_class=functools.partial(
            argparse.HelpFormatter, width=width, max_help_position=30
        ),
    )
    for title, keys in groups.items():
        nested = groups is not common and title != "options"
        described = options[keys[0]].group.replace("%", "%%") if nested else None
        group = parser.add_argument_group(title, described)
        for key in keys:
            _add(group, options[key])
    return parser.format_help()


def _by_prefix(options: Mapping[str, Option]) -> dict[str, list[str]]:
    """Keys by the dataclass that declares them; those of the job itself first."""
    groups: dict[str, list[str]] = {"options": []}
    for key in options:
        title = key.rpartition(".")[0].replace("_", "-") or "options"
        groups.setdefault(title, []).append(key)
    return {title: keys for title, keys in groups.items() if keys}


def _add(group: argparse._ArgumentGroup, option: Option) -> None:
    flag = "--" + option.key.replace("_", "-")
    text = f"{option.description}{_limits(option)}".replace("%", "%%")
    if _positional(option):
        group.add_argument(option.key, metavar=_name(option), help=text)
    elif isinstance(option.default, bool):
        prefix, _, name = flag.rpartition(".")
        opposite = f"{prefix}.no-{name}" if prefix else f"--no-{flag[2:]}"
        group.add_argument(flag, opposite, action="store_true", help=text)
    else:
        group.add_argument(flag, metavar=_placeholder(option), help=text)


def _limits(option: Option) -> str:
    """Default and range of an option in parentheses, as far as there are any."""
    parts = []
    default = option.default
    if default is REQUIRED:
        parts.append("required")
    elif isinstance(default, bool):
        parts.append(f"default: {'on' if default else 'off'}")
    elif isinstance(default, tuple) and default:
        parts.append(f"default: {' '.join(map(str, default))}")
    elif default is not None and default != ():
        parts.append(f"default: {default}")
    if option.range is not None:
        parts.append(f"range: {option.range}")
    return f" ({', '.join(parts)})" if parts else ""


def _positional(option: Option) -> bool:
    markers = getattr(Positional[int], "__metadata__", ())
    return any(marker in markers for marker in getattr(option.type, "__metadata__", ()))


def _name(option: Option) -> str:
    return option.key.upper()


def _usage(option: Option) -> str:
    if not _positional(option):
        return f"--{option.key.replace('_', '-')} {_placeholder(option)}"
    return _name(option) if option.default is REQUIRED else f"[{_name(option)} ...]"


def _placeholder(option: Option) -> str:
    """Placeholder of the value; a name where the description explains all choices."""
    choices = get_args(option.type) if get_origin(option.type) is Literal else ()
    words = set(re.findall(r"[\w-]+", option.description))
    if choices and words.issuperset(map(str, choices)):
        return option.key.rpartition(".")[2].upper()
    return _metavar(option.type)


def _metavar(hint: Any) -> str:
    """Placeholder of a value of a type, for instance "INT INT" or "{slam,given}"."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hasattr(hint, "__metadata__"):
        return _metavar(arguments[0])
    if origin is Literal:
        return "{" + ",".join(map(str, arguments)) + "}"
    if origin in (Union, types.UnionType):
        return "|".join(_metavar(a) for a in arguments if a is not type(None))
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"[{_metavar(arguments[0])} ...]"
    if origin is tuple:
        return " ".join(map(_metavar, arguments))
    return _NAMES[hint]
