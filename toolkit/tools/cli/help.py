"""Help pages of the jobs, generated from the declared options in the layout of argparse.

tyro parses the same declarations, but its help is three times as long.
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

from toolkit.base.options import REQUIRED, Option, nested_options

FLAGS = frozenset(("-h", "--help", "--help-all"))

# Keys of the options displayed by `--help`, by group; `--help-all` displays all. Jobs without an
# entry have few options and always display all.
COMMON: Mapping[str, Mapping[str, Sequence[str]]] = {
    "run": {
        "input": (
            "dataset.kind",
            "dataset.path",
            "image_size",
            "max_frames",
            "hold_out",
            "depth",
            "poses",
            "map",
        ),
        "output": ("out", "resume", "config", "record"),
        "quality and speed": (
            "preset",
            "mapping.iterations",
            "pace",
            "device",
            "seed",
        ),
        "semantics": (
            "segmenter.kind",
            "semantics.taxonomy",
            "semantics.ignore",
        ),
        "submaps and loops": ("submaps.use", "loops.use"),
    },
    "live": {
        "camera": ("camera", "fps", "serial", "timeout_s", "dataset.kind", "dataset.path"),
        "input": ("image_size", "max_frames", "map"),
        "output": ("out", "config", "record", "save_frames"),
        "quality and speed": (
            "preset",
            "pace",
            "pacing.max_delay_s",
            "mapping.iterations",
            "device",
            "seed",
        ),
        "semantics": ("segmenter.kind", "semantics.taxonomy"),
        "submaps and loops": ("submaps.use", "loops.use"),
    },
    "register": {"options": ("run_a", "run_b", "out", "pairs", "registration.kind")},
}

# Longer choices are listed behind the description.
_MAX_PLACEHOLDER = 60
_NAMES = {int: "INT", float: "FLOAT", str: "TEXT", Path: "PATH"}


def help_page(kind: type, job: str, everything: bool = False) -> str:
    """Return the help page of a job.

    Args:
        kind: dataclass of the job's arguments.
        job: name of the job.
        everything: list all options instead of the common ones.
    """
    options = {option.key: option for option in nested_options(kind)}
    common = COMMON.get(job)
    groups = _by_prefix(options) if everything or common is None else common
    required = [o for o in options.values() if o.default is REQUIRED or is_positional(o)]
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
    """Group keys by the dataclass that declares them, those of the job itself first."""
    groups: dict[str, list[str]] = {"options": []}
    for key in options:
        title = key.rpartition(".")[0].replace("_", "-") or "options"
        groups.setdefault(title, []).append(key)
    return {title: keys for title, keys in groups.items() if keys}


def _add(group: argparse._ArgumentGroup, option: Option) -> None:
    names, is_switch = option_names(option), isinstance(option.default, bool)
    choices = "" if is_switch else _choices(option)
    text = f"{option.description}{choices}{_limits(option)}".replace("%", "%%")
    if is_positional(option):
        group.add_argument(option.key, metavar=names[0], help=text)
    elif is_switch:
        group.add_argument(*names, action="store_true", help=text)
    else:
        group.add_argument(names[0], metavar=_placeholder(option), help=text)


def option_names(option: Option) -> list[str]:
    """Return the names of an option on the command line.

    These are the flag and, for a switch, the flag that turns it off; the placeholder of a
    positional argument.
    """
    if is_positional(option):
        return [option.key.upper()]
    flag = "--" + option.key.replace("_", "-")
    if not isinstance(option.default, bool):
        return [flag]
    prefix, _, name = flag.rpartition(".")
    return [flag, f"{prefix}.no-{name}" if prefix else f"--no-{flag[2:]}"]


def default_text(option: Option) -> str:
    """Return the default value as given on the command line, empty if there is none."""
    default = option.default
    if default is REQUIRED or default is None:
        return ""
    if isinstance(default, bool):
        return "on" if default else "off"
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def _limits(option: Option) -> str:
    """Return default and range of an option in parentheses, as far as they exist."""
    parts = ["required"] if option.default is REQUIRED else []
    if default := default_text(option):
        parts.append(f"default: {default}")
    if option.range is not None:
        parts.append(f"range: {option.range}")
    return f" ({', '.join(parts)})" if parts else ""


def is_positional(option: Option) -> bool:
    """Whether the option is a positional argument."""
    markers = getattr(Positional[int], "__metadata__", ())
    return any(marker in markers for marker in getattr(option.type, "__metadata__", ()))


def _usage(option: Option) -> str:
    name = option_names(option)[0]
    if not is_positional(option):
        return f"{name} {_placeholder(option)}"
    return name if option.default is REQUIRED else f"[{name} ...]"


def _placeholder(option: Option) -> str:
    """Return the placeholder of the value; a name if the choices are described or listed."""
    if _explains_choices(option) or _choices(option):
        return option.key.rpartition(".")[2].upper()
    return type_text(option.type)


def _explains_choices(option: Option) -> bool:
    choices = get_args(option.type) if get_origin(option.type) is Literal else ()
    described = set(re.findall(r"[\w-]+", option.description))
    return bool(choices) and described.issuperset(map(str, choices))


def _choices(option: Option) -> str:
    """Return a sentence with the choices if they are too long for a placeholder."""
    text = type_text(option.type)
    if not text.startswith("{") or len(text) <= _MAX_PLACEHOLDER or _explains_choices(option):
        return ""
    return f" One of {', '.join(text[1:-1].split(','))}."


def type_text(hint: Any) -> str:
    """Return the placeholder of a type, for instance "INT INT" or "{slam,given}"."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hasattr(hint, "__metadata__"):
        return type_text(arguments[0])
    if origin is Literal:
        return "{" + ",".join(map(str, arguments)) + "}"
    if origin in (Union, types.UnionType):
        return "|".join(type_text(a) for a in arguments if a is not type(None))
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"[{type_text(arguments[0])} ...]"
    if origin is tuple:
        return " ".join(map(type_text, arguments))
    return _NAMES[hint]
