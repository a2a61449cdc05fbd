"""`semsplat serve`: a finished run over HTTP, or for assistants over stdin and stdout."""

from __future__ import annotations

import logging

from toolkit.io.addresses import bind, is_local
from toolkit.tools.cli.map_programs import ServeOptions
from toolkit.tools.serving.server import serve, serve_mcp

_log = logging.getLogger(__name__)


def main(options: ServeOptions) -> int:
    """Serve a run until the program is interrupted.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run, the port cannot be used, or a package is not
            installed.
    """
    if options.mcp:
        serve_mcp(options.run, options.limits, options.changes)
        return 0
    if not is_local(options.host):
        _log.warning(
            "Anyone who can connect to %s can read the map, without password or encryption; a "
            "reverse proxy adds both, see docs/guides/service.md.",
            options.host,
        )
    serve(
        options.run,
        bind(options.host, options.port),
        options.limits,
        lambda url: print(f"serving {options.run} at {url}; stop with Ctrl-C", flush=True),
    )
    return 0
