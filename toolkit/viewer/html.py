"""The page: one HTML file with the scene, the program and its style."""

from __future__ import annotations

import base64
import json
from html import escape
from importlib.resources import files
from pathlib import Path

from toolkit.io.atomic import utf8, write_bytes, write_text
from toolkit.viewer.packing import PackedScene, pack
from toolkit.viewer.scene import ViewerScene

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
    "panel.js",
    "viewer.js",
)


def write_page(path: Path, scene: ViewerScene) -> int:
    """Write the offline page of a scene.

    Returns:
        The size of the file in bytes.

    Raises:
        RunFolderError: the file cannot be written.
    """
    content = utf8(page(pack(scene)))
    write_bytes(path, content)
    return len(content)


def page(packed: PackedScene, connect: str = "") -> str:
    """Return the page of a scene; a browser needs no other file.

    Args:
        packed: the scene.
        connect: sources that the page may load data from; by default it has no network.
    """
    # "</script>" in a name must not end the element.
    header = json.dumps(packed.header, ensure_ascii=False, separators=(",", ":"))
    parts = {
        "TITLE": escape(packed.header["title"]),
        "CONNECT": f"; connect-src {connect}" if connect else "",
        "STYLE": _source("style.css"),
        "SCENE": header.replace("<", "\\u003c"),
        "DATA": base64.b64encode(bytes(packed.data)).decode(),
        "WORKER": _source("sort_worker.js"),
        "SCRIPT": "\n".join(_source(name) for name in SCRIPTS),
    }
    text = _source("page.html")
    before, *rest = text.split("<!--@")
    pieces = [before]
    for piece in rest:
        name, _, after = piece.partition("-->")
        pieces += [parts[name], after]
    return "".join(pieces)


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
    return (files("toolkit.viewer") / "page" / name).read_text(encoding="utf-8")
