"""`semsplat view`: a local server that shows a map in the browser, with viser."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import socket
import time
from collections.abc import Callable
from typing import Any

from toolkit.errors import DependencyError, SettingsError, ToolkitError
from toolkit.viewer.live import LiveRun
from toolkit.viewer.scene import ViewerScene
from toolkit.viewer.server_controls import Controls
from toolkit.viewer.server_scene import ServerScene

_log = logging.getLogger(__name__)

_POLL_S = 1.0
# Share of the time in which a run is read and shown, so that the run itself is not slowed down.
_BUSY_SHARE = 0.3


def start_viser(host: str, port: int) -> Any:
    """Start a viser server.

    Args:
        host: address to listen on.
        port: port to listen on; 0 takes any free port.

    Raises:
        DependencyError: viser is missing.
        SettingsError: the address or the port cannot be used.
    """
    try:
        import viser
    except ImportError as error:
        raise DependencyError(
            f"semsplat view needs viser ({error}); run: pip install 'semsplat[viewer]'"
        ) from error
    # viser would silently take the next free port.
    port = free_port(host, port)
    # viser prints its address on stdout even if it is not verbose.
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host=host, port=port, label="semsplat", verbose=False)


def free_port(host: str, port: int) -> int:
    """Return a port, or a free one for 0.

    Raises:
        SettingsError: the address or the port cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return int(probe.getsockname()[1])
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise SettingsError(
                f"port {port} of {host} is in use; choose another one with --port, or --port 0 for "
                "any free port"
            ) from error
        raise SettingsError(
            f"cannot listen on {host} port {port} ({error.strerror or error}); check --host and "
            "--port"
        ) from error


def stop_viser(server: Any) -> None:
    """Stop a viser server."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


class MapServer:
    """Shows a scene to all browsers that connect.

    Args:
        server: a viser server.
        highlight: names of classes and groups that are highlighted at the start.
    """

    def __init__(self, server: Any, highlight: str = "") -> None:
        self._server = server
        self._highlight = highlight
        self._view: ServerScene | None = None
        self._controls: Controls | None = None

    def show(self, scene: ViewerScene) -> None:
        """Show a scene in place of the one before; the views of the browsers stay."""
        if self._view is None or self._controls is None:
            self._view = ServerScene(self._server, scene)
            self._controls = Controls(self._server, self._view, self._highlight)
        else:
            self._view.replace(scene)
            self._controls.replaced()

    def follow(self, run: LiveRun, wait: Callable[[float], object]) -> None:
        """Show a run in progress until it is finished.

        Args:
            run: the run.
            wait: called with the seconds between two looks at the run.

        Raises:
            ToolkitError: the first state cannot be read. Later ones are only reported, because the
                run may be stopped and started anew while it is followed.
        """
        message = ""
        while not run.finished:
            begin_s = time.monotonic()
            try:
                scene, news = run.poll(), ""
            except ToolkitError as error:
                if self._view is None:
                    raise
                scene, news = None, f"The run cannot be read at the moment: {error}"
            if scene is not None and len(scene.splats):
                self.show(scene)
                news = f"Show {scene.title}: {scene}."
            elif self._view is None:
                news = "Waiting for the first frames of the run."
            if news and news != message:
                _log.info(news)
                message = news
            if not run.finished:
                busy_s = time.monotonic() - begin_s
                wait(max(_POLL_S, busy_s * (1.0 / _BUSY_SHARE - 1.0)))
        _log.info("The run is finished.")
