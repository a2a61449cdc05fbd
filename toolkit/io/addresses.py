"""Addresses on which programs listen."""

from __future__ import annotations

import errno
import ipaddress
import socket

from toolkit.base.errors import SettingsError

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
