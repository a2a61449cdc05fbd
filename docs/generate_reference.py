"""MkDocs hook: generate the reference of options and Python API, and the page of rooms.

The options come from the declarations of the jobs' arguments, the API and the rooms from
docstrings. The pages exist only in the built site: `make docs`.
"""

from __future__ import annotations

import ast
import configparser
import importlib
import inspect
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import toolkit
from toolkit.base.options import REQUIRED, Option, nested_options
from toolkit.tools.cli.help import default_text, option_names, type_text
from toolkit.tools.cli.live import LiveProgram
from toolkit.tools.cli.main import JOBS
from toolkit.tools.cli.programs import PROGRAMS
from toolkit.tools.cli.run import RunProgram

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files

OPTIONS_PAGE = "reference/options.md"
API_PAGE = "reference/python-api.md"
ROOMS_PAGE = "contributing/where-things-are.md"
_PACKAGE = Path(toolkit.__file__).parent
# Classes and functions of the API page, beyond the names that `import toolkit` offers.
API = {
    "Run SLAM": (
        "toolkit.slam.system.Slam",
        "toolkit.slam.result.SlamResult",
        "toolkit.slam.result.FrameResult",
    ),
    "Real time": ("toolkit.slam.pacing.paced.PacedSlam", "toolkit.slam.pacing.delays.PaceSummary"),
    "Live cameras and observers": (
        "toolkit.runs.live.execution.run_live",
        "toolkit.runs.live.camera.LiveCamera",
        "toolkit.runs.live.camera.CapturedFrame",
        "toolkit.runs.observers.ProgressObserver",
        "toolkit.runs.observers.ObservedRun",
    ),
    "Maps": (
        "toolkit.splatting.gaussians.cloud.GaussianCloud",
        "toolkit.splatting.rendering.RenderOutput",
        "toolkit.io.splats.read_splats",
        "toolkit.io.splats.write_splat_ply",
        "toolkit.io.meshes.fuse_views",
    ),
    "Semantics": (
        "toolkit.semantics.taxonomy.Taxonomy",
        "toolkit.scene.query.LabelledMap",
        "toolkit.semantics.lexicon.matching.match",
        "toolkit.semantics.embedding_fusion.fuse_views",
        "toolkit.io.object_embeddings.ObjectEmbeddings",
        "toolkit.io.object_embeddings.read_objects",
        "toolkit.io.object_embeddings.write_objects",
        "toolkit.semantics.taxonomy_building.builder.build_taxonomy",
    ),
    "Objects, rooms and paths": (
        "toolkit.exports.mapped_scene.map_scene",
        "toolkit.exports.mapped_scene.MappedScene",
        "toolkit.exports.map_changes.changes_between",
        "toolkit.scene.graph.rooms.find_rooms",
        "toolkit.scene.graph.rooms.RoomMap",
        "toolkit.scene.graph.paths.PathFinder",
        "toolkit.scene.graph.paths.FreePath",
        "toolkit.scene.graph.measures.surface_distance",
        "toolkit.scene.graph.measures.free_width_m",
    ),
    "Geometry": (
        "toolkit.base.geometry.camera.Camera",
        "toolkit.base.geometry.trajectory.Trajectory",
        "toolkit.base.geometry.frustum.inside_frustum",
    ),
}
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises|Yields):\s*$")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages to the site."""
    from mkdocs.structure.files import File

    for name, page in GENERATED.items():
        files.append(File.generated(config, name, content=page()))
    return files


def options_page() -> str:
    """All options of all jobs, in one table for each group."""
    lines = [
        "# Options",
        "",
        "This page is generated from the declarations of the options. In a YAML file for "
        "`--config`, the dots of an option separate nested keys and its dashes are underscores: "
        "`--placement.max-width 160` is `placement: {max_width: 160}`. A switch `--x` has the "
        "opposite `--no-x`.",
    ]
    for job, (_, description) in JOBS.items():
        options = job_options(job)
        if options:
            lines += ["", f"## semsplat {job}", "", description[0].upper() + description[1:] + "."]
        for group, members in _grouped(options).items():
            if group:
                lines += ["", f"### {job}: {group}"]
            lines += ["", "| option | values | default | description |", "|---|---|---|---|"]
            lines += [_row(option) for option in members]
    return "\n".join(lines) + "\n"


def job_options(job: str) -> tuple[Option, ...]:
    """The options of a job, without help."""
    kind = {**PROGRAMS, "run": RunProgram, "live": LiveProgram}.get(job)
    return () if kind is None else nested_options(kind)


def _grouped(options: Sequence[Option]) -> dict[str, list[Option]]:
    groups: dict[str, list[Option]] = {"": []}
    for option in options:
        groups.setdefault(option.key.rpartition(".")[0].replace("_", "-"), []).append(option)
    return {group: members for group, members in groups.items() if members}


def _row(option: Option) -> str:
    values = "switch" if isinstance(option.default, bool) else _code(_values(option))
    if option.range is not None:
        values += f" {option.range}"
    default = "required" if option.default is REQUIRED else _code(default_text(option))
    cells = (f"`{option_names(option)[0]}`", values, default, option.description)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _values(option: Option) -> str:
    return re.sub(r"[{}]", "", type_text(option.type)).replace(",", ", ")


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


def rooms_page() -> str:
    """The rooms from high to low, with their packages and modules in their own words."""
    lines = [
        "# Where things are",
        "",
        "This page is generated from docstrings. `toolkit/` has eleven packages, the rooms, from "
        "high to low: a room imports only those below it. [How it works]"
        "(../concepts/overview.md#structure-of-the-code) has the calls of one frame, and "
        "`CONTRIBUTING.md` a table of where a change goes.",
    ]
    for room in rooms():
        lines += ["", f"## {room}", "", *_described(_PACKAGE / room), *_modules(_PACKAGE / room)]
        for package in sorted(_packages(_PACKAGE / room)):
            name = package.relative_to(_PACKAGE).as_posix()
            lines += ["", f"### {name}", "", *_described(package), *_modules(package)]
    return "\n".join(lines) + "\n"


def rooms() -> list[str]:
    """Names of the rooms, in the order that `import-linter` checks."""
    settings = configparser.ConfigParser(interpolation=None)
    settings.read(_PACKAGE.parent / "setup.cfg", encoding="utf-8")
    return re.findall(r"\w+", settings["importlinter:contract:layers"]["layers"])


def _packages(folder: Path) -> Iterator[Path]:
    """The packages inside a package, at all depths."""
    return (path.parent for path in folder.rglob("__init__.py") if path.parent != folder)


def _described(package: Path) -> list[str]:
    """The docstring of a package; what it knows, takes, gives and offers becomes a list."""
    text = _docstring(package / "__init__.py")
    return re.sub(r"^(Knows|In|In and out|For others):", r"- **\1**:", text, flags=re.M).split("\n")


def _modules(package: Path) -> list[str]:
    """A table of the modules of a package."""
    modules = sorted(path for path in package.glob("*.py") if path.stem != "__init__")
    rows = [f"| `{module.stem}` | {_first_line(module)} |" for module in modules]
    return ["", "| module | content |", "|---|---|", *rows] if rows else []


def _first_line(module: Path) -> str:
    return _docstring(module).partition("\n")[0].replace("|", "\\|")


def _docstring(file: Path) -> str:
    return ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""


# The pages, and what writes each.
GENERATED = {OPTIONS_PAGE: options_page, API_PAGE: api_page, ROOMS_PAGE: rooms_page}
