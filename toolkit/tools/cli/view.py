"""`semsplat view`: show a map in the browser."""

from __future__ import annotations

import logging
import os
import time

import torch

from toolkit.base.errors import SettingsError
from toolkit.io.addresses import bind, is_local
from toolkit.tools.cli.map_programs import ViewOptions
from toolkit.tools.viewer.live import LiveRun, follow
from toolkit.tools.viewer.reading import read_scene
from toolkit.tools.viewer.scene import ViewerScene
from toolkit.tools.viewer.server import MapServer
from toolkit.tools.viewer.streaming import ServedMap, StreamedMap, WholeMap

_log = logging.getLogger(__name__)

_NICENESS = 10


def main(options: ViewOptions) -> int:
    """Show a map until the program is interrupted.

    Returns:
        0 after Ctrl-C.

    Raises:
        ToolkitError: there is no map, it cannot be read, or the port cannot be used.
    """
    if options.live:
        _yield_to_the_run()
    server = MapServer(bind(options.host, options.port), options.host)
    try:
        if options.live:
            _follow(options, server)
        else:
            _show(options, server)
        while True:
            time.sleep(3600.0)
    except KeyboardInterrupt:
        return 0
    finally:
        server.stop()


def _show(options: ViewOptions, server: MapServer) -> None:
    """Serve a finished map."""
    scene = read_scene(options.map, options.viewer, whole=True)
    text = ", ".join(options.highlight)
    if text and (scene.tree is None or not scene.tree.matching(text)):
        raise SettingsError(
            f"{options.map} has no class of --highlight {text}; list its classes with: "
            "semsplat query RUN --list"
        )
    server.show(_served(scene, options), finished=True)
    _announce(options, server)
    _log.info("Show %s. Ctrl-C stops.", scene)


def _follow(options: ViewOptions, server: MapServer) -> None:
    """Serve a run in progress until it is finished."""
    run = LiveRun(options.map, options.viewer)
    _announce(options, server)
    follow(run, server, lambda scene: _served(scene, options), time.sleep)


def _served(scene: ViewerScene, options: ViewOptions) -> ServedMap:
    """Let browsers load the levels of detail of a large map."""
    text = ", ".join(options.highlight)
    if len(scene.splats) <= options.viewer.max_gaussians:
        return WholeMap(scene, text)
    _log.info("Build the levels of detail of %s.", scene)
    return StreamedMap.build(scene, options.budget, text)


def _announce(options: ViewOptions, server: MapServer) -> None:
    if not is_local(options.host):
        _log.warning("Anyone who can connect to %s can see this map.", options.host)
    # The address is the program's result; other programs read it.
    print(server.url, flush=True)


def _yield_to_the_run() -> None:
    """Leave the processor to the run that is followed, if it needs it."""
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
