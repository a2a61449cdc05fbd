"""The process of one run of a plan; started by `toolkit/runs/batch/process.py`, not by users."""

from __future__ import annotations

import logging
import os
import sys
import threading
from pathlib import Path

from toolkit.runs.lock import locked
from toolkit.runs.settings import load_settings
from toolkit.tools.cli.errors import one_line_errors

# A process whose parent has ended needs a moment to end itself.
_PATIENCE_S = 20.0
# Exit status of a run whose parent has ended.
_PARENT_ENDED = 125


def main(arguments: list[str]) -> int:
    """Execute or resume the run of a settings file.

    The standard input must be a pipe of the parent process.

    Args:
        arguments: settings file and run folder.
    """
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    config, folder = map(Path, arguments)
    return one_line_errors(lambda: _run(config, folder))


def _run(config: Path, folder: Path) -> int:
    # Imports torch, which takes seconds.
    from toolkit.runs.execution import run
    from toolkit.runs.folder import RunFolder

    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    logging.getLogger("toolkit").setLevel(logging.INFO)
    with locked(folder, _PATIENCE_S):
        begun = (folder / "config.yaml").is_file()
        if not begun:
            # The remains of a process that was killed before it had written its settings.
            RunFolder(folder).discard()
    run(load_settings(config), folder, resume=begun)
    return 0


def _exit_with_parent() -> None:
    # The pipe ends when the parent has ended. Read from the descriptor: a thread that waits in
    # sys.stdin would abort the interpreter at exit.
    while os.read(0, 1024):
        pass
    os._exit(_PARENT_ENDED)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
