"""MkDocs hook: generate the reference of all options and of the public Python API.

The options come from the parsers of the programs, the API from docstrings. The pages exist only
in the built site: `make docs`.
"""

from __future__ import annotations

import importlib
import inspect
import re
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import tyro

import toolkit
from toolkit.cli.main import JOBS
from toolkit.options import nested_options
from toolkit.runs.settings import RunSettings

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

OPTIONS_PAGE = "reference/options.md"
API_PAGE = "reference/python-api.md"
# Classes and functions of the API page, beyond the names that `import toolkit` offers.
API = {
    "Run SLAM": ("toolkit.slam.Slam", "toolkit.result.SlamResult", "toolkit.result.FrameResult"),
    "Maps": (
        "toolkit.gaussians.cloud.GaussianCloud",
        "toolkit.rendering.RenderOutput",
        "toolkit.io.splats.read_splats",
        "toolkit.io.splats.write_splat_ply",
        "toolkit.io.meshes.fuse_views",
    ),
    "Semantics": (
        "toolkit.semantics.taxonomy.Taxonomy",
        "toolkit.semantics.query.LabelledMap",
        "toolkit.taxonomy_building.builder.build_taxonomy",
    ),
    "Geometry": (
        "toolkit.geometry.camera.Camera",
        "toolkit.geometry.trajectory.Trajectory",
        "toolkit.geometry.viewing_volume.ViewingVolume",
    ),
}
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):\s*$")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site."""
    from mkdocs.structure.files import File

    for name, content in ((OPTIONS_PAGE, options_page()), (API_PAGE, api_page())):
        files.append(File.generated(config, name, content=content))
    return files


def options_page() -> str:
    """All options of all programs, in one table for each group."""
    lines = [
        "# Options",
        "",
        "This page is generated from the declarations of the options. In a YAML file for "
        "`--config`, the dots of an option separate nested keys and its dashes are underscores: "
        "`--tracking.dense.levels 3` is `tracking: {dense: {levels: 3}}`. A switch `--x` has the "
        "opposite `--no-x`.",
    ]
    for job, (module, meaning) in JOBS.items():
        actions = list(job_options(module))
        if actions:
            lines += ["", f"## semsplat {job}", "", meaning[0].upper() + meaning[1:] + "."]
        for group, members in _grouped(actions):
            if group:
                lines += ["", f"### {job}: {group}"]
            lines += ["", "| option | values | default | description |", "|---|---|---|---|"]
            lines += [_row(action) for action in members]
    return "\n".join(lines) + "\n"


def job_options(module_name: str) -> Iterator[Any]:
    """The argparse actions of a job's parser, without help."""
    module = importlib.import_module(f"toolkit.cli.{module_name}")
    if not hasattr(module, "parse_arguments"):
        return
    found: list[Any] = []

    def record(kind: type, *_: object, **options: Any) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            found.extend(tyro.extras.get_parser(kind, **options)._actions)
        raise _RecordedError

    original = module.parse_arguments
    module.parse_arguments = record  # type: ignore[attr-defined]
    try:
        module.main([])
    except _RecordedError:
        pass
    finally:
        module.parse_arguments = original  # type: ignore[attr-defined]
    yield from (action for action in found if "--help" not in action.option_strings)


class _RecordedError(Exception):
    """The parser has been recorded."""


def _grouped(actions: Sequence[Any]) -> Iterator[tuple[str, list[Any]]]:
    groups: dict[str, list[Any]] = {}
    for action in actions:
        name = action.option_strings[0].lstrip("-") if action.option_strings else ""
        groups.setdefault(name.rpartition(".")[0], []).append(action)
    yield from groups.items()


def _row(action: Any) -> str:
    names = action.option_strings[:1] or [str(action.metavar)]
    text, _, default = re.sub(r"\x1b\[[\d;]*m", "", action.help or "").partition("(default: ")
    if not default:
        text, _, _ = text.partition("(required)")
    default = default.rstrip(" )").replace("None", "")
    values = [_values(action), *_range(names[0])]
    shown_default = "required" if default == "required" else _code(default)
    cells = (f"`{names[0]}`", " ".join(filter(None, values)), shown_default, text)
    return "| " + " | ".join(" ".join(c.split()).replace("|", "\\|") for c in cells) + " |"


def _values(action: Any) -> str:
    if len(action.option_strings) > 1 or (action.option_strings and action.nargs == 0):
        return "switch"
    metavar = action.metavar
    shown = " ".join(metavar) if isinstance(metavar, tuple) else str(metavar or "")
    shown = re.sub(r"\{?None\}?\|", "", shown)
    return _code(re.sub(r"[{}]", "", shown).replace(",", ", ")) if shown else ""


def _range(option: str) -> list[str]:
    key = option.lstrip("-").replace("-", "_")
    ranges = {o.key: o.range for o in nested_options(RunSettings)}
    return [str(ranges[key])] if ranges.get(key) is not None else []


def _code(text: str) -> str:
    return f"`{text}`" if text else ""


def api_page() -> str:
    """Signatures and docstrings of the public names."""
    lines = [
        "# Python API",
        "",
        "This page is generated from docstrings. The names of the first section are available as "
        "`toolkit.NAME`; the others are imported from their modules. Conventions of frames, units "
        "and types are on their [own page](conventions.md).",
        "",
        "## toolkit",
    ]
    for name in toolkit.__all__:
        lines += _entry(f"toolkit.{name}", getattr(toolkit, name))
    for title, names in API.items():
        lines += ["", f"## {title}"]
        for dotted in names:
            module, _, name = dotted.rpartition(".")
            lines += _entry(dotted, getattr(importlib.import_module(module), name))
    return "\n".join(lines) + "\n"


def _entry(dotted: str, value: Any) -> list[str]:
    lines = ["", f"### {dotted}", "", "```python", _signature(dotted, value), "```", ""]
    lines += markdown_docstring(inspect.getdoc(value) or "")
    if inspect.isclass(value):
        for name, member in vars(value).items():
            function = member.__func__ if isinstance(member, classmethod | staticmethod) else member
            if name.startswith("_") or not inspect.isfunction(function):
                continue
            lines += ["", f"#### {value.__name__}.{name}", "", "```python"]
            lines += [_signature(name, function), "```", ""]
            lines += markdown_docstring(inspect.getdoc(function) or "")
    return lines


def _signature(name: str, value: Any) -> str:
    signature = inspect.signature(value)
    parameters = [p for p in signature.parameters.values() if p.name not in ("self", "cls")]
    if len(parameters) < 3:
        return f"{name}{signature.replace(parameters=parameters)}".replace("'", "")
    end = (
        ""
        if signature.return_annotation is signature.empty
        else f" -> {signature.return_annotation}"
    )
    body = "".join(f"    {parameter},\n" for parameter in parameters)
    return f"{name}(\n{body}){end}".replace("'", "")


def markdown_docstring(text: str) -> list[str]:
    """A Google-style docstring as Markdown: sections become lists."""
    lines: list[str] = []
    in_section = False
    for line in text.splitlines():
        section = _SECTION.match(line)
        if section:
            title = {"Args": "Arguments"}.get(section[1], section[1])
            lines += ["", f"**{title}**", ""]
            in_section = True
        elif in_section and line.startswith("    ") and not line.startswith("     "):
            name, colon, rest = line.strip().partition(": ")
            lines.append(f"- `{name}`: {rest}" if colon and len(name) < 60 else f"- {line.strip()}")
        elif in_section and line.strip() and line.startswith("  "):
            lines.append(f"  {line.strip()}")
        else:
            in_section = in_section and not line.strip()
            lines.append(line)
    return lines
