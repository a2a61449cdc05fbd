"""Start the service on a bound port, or over stdin and stdout."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path

from toolkit.base.errors import DependencyError
from toolkit.io.addresses import is_local, url_of
from toolkit.tools.serving.options import EarlierRun, ServiceLimits


def serve(
    path: Path, bound: socket.socket, limits: ServiceLimits, ready: Callable[[str], None]
) -> None:
    """Serve a run until the process is interrupted.

    Args:
        path: the run folder.
        bound: the socket, closed at the end.
        ready: called with the URL when the run has been loaded.

    Raises:
        DependencyError: the packages of the extra `server` are missing.
        ToolkitError: there is no finished run, or a file is damaged.
    """
    with bound:
        try:
            import uvicorn

            from toolkit.tools.serving.admission import Computations
            from toolkit.tools.serving.application import build_application
            from toolkit.tools.serving.connections import bounded_protocol
        except ModuleNotFoundError as error:
            raise DependencyError(
                f"semsplat serve needs {error.name}: pip install 'semsplat[server]'"
            ) from error
        from toolkit.tools.serving.served_run import ServedRun

        run = ServedRun(path, limits.max_pixels)
        computations = Computations(limits.max_waiting)
        local = is_local(bound.getsockname()[0])
        config = uvicorn.Config(
            build_application(run, limits, computations, local),
            http=bounded_protocol(limits.max_connections),
            ws="none",
            lifespan="off",
            access_log=False,
            log_level="warning",
            server_header=False,
            # The address of a client is that of its connection: a header could be forged.
            proxy_headers=False,
            timeout_keep_alive=15,
            timeout_graceful_shutdown=5,
        )
        try:
            ready(url_of(bound))
            uvicorn.Server(config).run(sockets=[bound])
        except KeyboardInterrupt:
            return
        finally:
            computations.close()


def serve_mcp(path: Path, limits: ServiceLimits, earlier: EarlierRun) -> None:
    """Answer an assistant over stdin and stdout until stdin ends.

    Args:
        path: the run folder.
        earlier: the earlier run of the place, for changes.

    Raises:
        DependencyError: the packages of the extra `agents` are missing.
        ToolkitError: there is no finished run, or a file is damaged.
    """
    try:
        from toolkit.tools.serving.agents import serve_agents
    except ModuleNotFoundError as error:
        raise DependencyError(
            f"semsplat serve --mcp needs {error.name}: pip install 'semsplat[agents]'"
        ) from error
    from toolkit.tools.serving.map_tools import MapTools
    from toolkit.tools.serving.served_run import ServedRun

    run = ServedRun(path, limits.max_pixels)
    try:
        serve_agents(run, MapTools(run, earlier), limits.max_waiting)
    except KeyboardInterrupt:
        return
