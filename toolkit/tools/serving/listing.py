"""The page at `/`: the paths of the service. It needs no network and no scripts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jinja2

from toolkit.base.version import __version__
from toolkit.io.length_names import LengthNames


@dataclass(frozen=True)
class Listed:
    """One path of the service: its method, and what it answers in one line."""

    method: str
    path: str
    summary: str


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{{ name }} - semsplat</title>
<style>
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 52em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; width: 100%; }
td { padding: 6px 14px 6px 0; border-bottom: 1px solid #8884; vertical-align: top; }
pre { background: #8882; padding: 10px 14px; border-radius: 6px; white-space: pre-wrap; }
</style>
</head>
<body>
<h1>{{ name }}</h1>
<p>A finished run of semsplat {{ version }}. Lengths are in {{ "metres" if metric
else "an arbitrary unit" }}, poses are T_map_camera (x right, y down, z forward), quaternions are
x y z w.</p>
<table>
{% for item in paths %}
<tr><td>{{ item.method }}</td>
<td>{% if item.method == "GET" and "{" not in item.path and item.path != "/query" %}
<a href="{{ item.path[1:] }}"><code>{{ item.path }}</code></a>
{% else %}<code>{{ item.path }}</code>{% endif %}</td>
<td>{{ item.summary }}</td></tr>
{% endfor %}
</table>
<p>Parameters and bodies are described in <a href="openapi.json"><code>openapi.json</code></a>
(OpenAPI 3.1). Examples:</p>
<pre>curl 'http://127.0.0.1:8000/keyframes/0.png?what=classes&amp;level=0' -o classes.png
curl 'http://127.0.0.1:8000/query?name=chair'
curl http://127.0.0.1:8000/render -o view.png -H 'Content-Type: application/json' -d \\
  '{"translation_m": [0, 0, -0.5], "quaternion_xyzw": [0, 0, 0, 1], "what": "depth"}'</pre>
</body>
</html>
"""


def listing_page(name: str, lengths: LengthNames, paths: Sequence[Listed]) -> str:
    """Return the page of a run with the paths of its service."""
    environment = jinja2.Environment(autoescape=True, trim_blocks=True)
    return environment.from_string(_PAGE).render(
        name=name, metric=lengths.metric, version=__version__, paths=paths
    )
