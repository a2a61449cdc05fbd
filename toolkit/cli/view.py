"""`semsplat view`: show a map in the browser."""

from __future__ import annotations

import logging
import os
import time

import torch

from toolkit.cli.map_programs import ViewOptions
from toolkit.errors import SettingsError
from toolkit.viewer.live import LiveRun
from toolkit.viewer.reading import read_scene
from toolkit.viewer.server import MapServer, start_viser, stop_viser

_log = logging.getLogger(__name__)

_NICENESS = 10
_LOCAL = ("127.0.0.1", "localhost", "::1")


def main(options: ViewOptions) -> int:
    """Show a map until the program is interrupted.

    Returns:
        0 after Ctrl-C.

    Raises:
        ToolkitError: there is no map, it cannot be read, or the port cannot be used.
    """
    if options.live:
        _yield_to_the_run()
    live = LiveRun(options.map, options.viewer) if options.live else None
    scene = None if options.live else read_scene(options.map, options.viewer)
    text = ", ".join(options.highlight)
    if text and scene is not None and (scene.tree is None or not scene.tree.matching(text)):
        raise SettingsError(
            f"{options.map} has no class of --highlight {text}; list its classes with: "
            "semsplat query RUN --list"
        )
    server = start_viser(options.host, options.port)
    try:
        if options.host not in _LOCAL:
            _log.warning("Anyone who can connect to %s can see this map.", options.host)
        shown = MapServer(server, text)
        # The address is the program's result; other programs read it.
        print(f"http://{options.host}:{server.get_port()}", flush=True)
        if scene is not None:
            shown.show(scene)
            _log.info("Show %s. Ctrl-C stops.", scene)
        elif live is not None:
            shown.follow(live, time.sleep)
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        return 0
    finally:
        stop_viser(server)


def _yield_to_the_run() -> None:
    """Leave the processor to the run that is followed, if it needs it."""
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
