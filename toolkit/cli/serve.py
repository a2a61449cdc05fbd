"""`semsplat serve`: an HTTP service for a finished run."""

from __future__ import annotations

import os

from toolkit.cli.map_programs import ServeOptions
from toolkit.serving.server import TOKEN_VARIABLE, bind, check_token, serve


def main(options: ServeOptions) -> int:
    """Serve a run until the program is interrupted.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run, the port cannot be used, a token is missing, or a
            package is not installed.
    """
    token = os.environ.get(TOKEN_VARIABLE) if options.token is None else options.token
    check_token(options.host, token)
    serve(
        options.run,
        bind(options.host, options.port),
        options.limits,
        token,
        lambda url: print(f"serving {options.run} at {url}; stop with Ctrl-C", flush=True),
    )
    return 0
