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
from toolkit.viewer.scene import ViewerScene
from toolkit.viewer.server import MapServer, free_port, start_viser, stop_viser
from toolkit.viewer.stream_server import LOCAL, StreamServer
from toolkit.viewer.streaming import StreamedMap

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
    live = LiveRun(options.map, options.viewer) if options.live else None
    scene = None if options.live else read_scene(options.map, options.viewer, whole=True)
    text = ", ".join(options.highlight)
    if text and scene is not None and (scene.tree is None or not scene.tree.matching(text)):
        raise SettingsError(
            f"{options.map} has no class of --highlight {text}; list its classes with: "
            "semsplat query RUN --list"
        )
    try:
        if scene is not None and _is_streamed(scene, options.viewer.max_gaussians):
            return _stream(options, scene, text)
        return _show(options, scene, live, text)
    except KeyboardInterrupt:
        return 0


def _is_streamed(scene: ViewerScene, max_gaussians: int) -> bool:
    """Whether a map is too large to be sent whole, or has harmonics, which only our page draws."""
    return len(scene.splats) > max_gaussians or scene.splats.harmonics is not None


def _show(options: ViewOptions, scene: ViewerScene | None, live: LiveRun | None, text: str) -> int:
    """Send a whole map, or a run in progress, to every browser."""
    server = start_viser(options.host, options.port)
    try:
        shown = MapServer(server, text)
        _announce(options, server.get_port())
        if scene is not None:
            shown.show(scene.thinned(options.viewer.max_gaussians))
            _log.info("Show %s. Ctrl-C stops.", scene)
        elif live is not None:
            shown.follow(live, time.sleep)
        _wait()
    finally:
        stop_viser(server)
    return 0


def _stream(options: ViewOptions, scene: ViewerScene, text: str) -> int:
    """Let browsers load the levels of detail that they show."""
    port = free_port(options.host, options.port)
    _log.info("Build the levels of detail of %s.", scene)
    server = StreamServer(StreamedMap.build(scene, options.budget, text), options.host, port)
    try:
        _announce(options, server.get_port())
        _log.info("Stream %s. Ctrl-C stops.", scene)
        _wait()
    finally:
        server.stop()
    return 0


def _announce(options: ViewOptions, port: int) -> None:
    if options.host not in LOCAL:
        _log.warning("Anyone who can connect to %s can see this map.", options.host)
    # The address is the program's result; other programs read it.
    print(f"http://{options.host}:{port}", flush=True)


def _wait() -> None:
    while True:
        time.sleep(3600.0)


def _yield_to_the_run() -> None:
    """Leave the processor to the run that is followed, if it needs it."""
    torch.set_num_threads(1)
    if hasattr(os, "nice"):
        os.nice(_NICENESS)
