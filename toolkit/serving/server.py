"""Start the service on a port of this machine, or over stdin and stdout."""

from __future__ import annotations

import errno
import ipaddress
import socket
from collections.abc import Callable
from pathlib import Path

from toolkit.errors import DependencyError, SettingsError
from toolkit.serving.options import EarlierRun, ServiceLimits

_BACKLOG = 128


def is_local(host: str) -> bool:
    """Return whether only this machine can reach an address. Other names are not looked up."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def bind(host: str, port: int) -> socket.socket:
    """Return a socket that is bound to an address; port 0 chooses a free one.

    Raises:
        SettingsError: the port is in use or reserved, or this machine does not have the address.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        raise SettingsError(f"--host {host} is not an address of this machine ({error})") from error
    try:
        # A port is free again at once after the service has ended.
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        bound.bind(address)
        # Listening reserves the port; clients wait while the run is loaded.
        bound.listen(_BACKLOG)
    except OSError as error:
        bound.close()
        if error.errno == errno.EADDRINUSE:
            raise SettingsError(
                f"port {port} of {host} is in use; choose another --port"
            ) from error
        if error.errno == errno.EACCES:
            raise SettingsError(
                f"port {port} is reserved for the system; choose a --port above 1023"
            ) from error
        raise SettingsError(
            f"cannot use port {port} of {host} ({error.strerror}); choose another --host or --port"
        ) from error
    return bound


def url_of(bound: socket.socket) -> str:
    """Return the URL of the service."""
    host, port = bound.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


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

            from toolkit.serving.admission import Computations
            from toolkit.serving.application import build_application
        except ModuleNotFoundError as error:
            raise DependencyError(
                f"semsplat serve needs {error.name}: pip install 'semsplat[server]'"
            ) from error
        from toolkit.serving.served_run import ServedRun

        run = ServedRun(path, limits.max_pixels)
        computations = Computations(limits.max_waiting)
        local = is_local(bound.getsockname()[0])
        config = uvicorn.Config(
            build_application(run, limits, computations, local),
            http="h11",
            ws="none",
            lifespan="off",
            access_log=False,
            log_level="warning",
            server_header=False,
            # The address of a client is that of its connection: a header could be forged.
            proxy_headers=False,
            limit_concurrency=limits.max_connections,
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
        from toolkit.serving.agents import serve_agents
    except ModuleNotFoundError as error:
        raise DependencyError(
            f"semsplat serve --mcp needs {error.name}: pip install 'semsplat[agents]'"
        ) from error
    from toolkit.serving.map_tools import MapTools
    from toolkit.serving.served_run import ServedRun

    run = ServedRun(path, limits.max_pixels)
    try:
        serve_agents(run, MapTools(run, earlier), limits.max_waiting)
    except KeyboardInterrupt:
        return
