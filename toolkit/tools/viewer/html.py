"""The page: one HTML file with the program, its style, and the scene unless a server sends it."""

from __future__ import annotations

import base64
import hashlib
import json
from html import escape
from importlib.resources import files
from pathlib import Path

from toolkit.io.atomic import utf8, write_bytes, write_text
from toolkit.tools.viewer.packing import pack
from toolkit.tools.viewer.scene import ViewerScene

# Scripts of the page, in the order in which they use each other.
SCRIPTS = (
    "scene_data.js",
    "vectors.js",
    "view_camera.js",
    "navigation.js",
    "gl_programs.js",
    "splat_renderer.js",
    "detail_stream.js",
    "pace.js",
    "line_renderer.js",
    "colouring.js",
    "picking.js",
    "elements.js",
    "object_tree.js",
    "panel.js",
    "viewer.js",
    "served_map.js",
    "start.js",
)


def write_page(path: Path, scene: ViewerScene) -> int:
    """Write the offline page of a scene, which needs no other file and no network.

    Returns:
        The size of the file in bytes.

    Raises:
        RunFolderError: the file cannot be written.
    """
    packed = pack(scene)
    header = json.dumps(packed.header, ensure_ascii=False, separators=(",", ":"))
    parts = {
        "TITLE": escape(scene.title),
        # "</script>" in a name must not end the element.
        "SCENE": header.replace("<", "\\u003c"),
        "DATA": base64.b64encode(bytes(packed.data)).decode(),
    }
    content = utf8(_page(parts))
    write_bytes(path, content)
    return len(content)


def served_page() -> bytes:
    """Return the page that loads the scene from its server."""
    parts = {"TITLE": "semsplat", "SCENE": "", "DATA": "", "CONNECT": "; connect-src 'self'"}
    return utf8(_page(parts))


def _page(parts: dict[str, str]) -> str:
    style = _source("style.css")
    script = "\n".join(['"use strict";', *map(_source, SCRIPTS)])
    parts = {
        "CONNECT": "",
        "STYLE": style,
        "WORKER": _source("sort_worker.js"),
        "SCRIPT": script,
        # Nothing else can run, whatever a name contains.
        "STYLE_HASH": _hash(style),
        "SCRIPT_HASH": _hash(script),
        **parts,
    }
    text = _source("page.html")
    before, *rest = text.split("<!--@")
    pieces = [before]
    for piece in rest:
        name, _, after = piece.partition("-->")
        pieces += [parts[name], after]
    return "".join(pieces)


def _hash(content: str) -> str:
    """Return the source of a content security policy that allows an inline element."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(utf8(content)).digest()).decode()}'"


def link_from_report(page_path: Path, report: Path) -> bool:
    """Add a link to the page to the report of a run, once.

    Returns:
        Whether the report contains the link.
    """
    if not report.is_file() or report.parent.resolve() != page_path.parent.resolve():
        return False
    text = report.read_text(encoding="utf-8")
    link = f'<p class="subtitle"><a href="{escape(page_path.name)}">Open the map in 3D</a></p>'
    if link in text:
        return True
    title_end = text.find("</h1>")
    if title_end < 0:
        return False
    place = title_end + len("</h1>")
    write_text(report, f"{text[:place]}\n{link}{text[place:]}")
    return True


def _source(name: str) -> str:
    return (files("toolkit.tools.viewer") / "page" / name).read_text(encoding="utf-8")
