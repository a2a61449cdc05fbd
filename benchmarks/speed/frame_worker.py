"""Processes one sequence frame by frame, on request; the worker of `earlier_commit`.

Uses only the public interface of the toolkit, so that it works with earlier commits. It is started
by its path, with the toolkit that PYTHONPATH names. Each line of input is answered with the time
in milliseconds: "frame" processes the next frame, "finish" refines the map and ends the program.
"""

from __future__ import annotations

import json
import sys
import time

import toolkit


def main() -> None:
    """Serve the requests of standard input for a dataset, with default settings."""
    kind, path, image_size = json.loads(sys.argv[1])
    dataset = toolkit.open_dataset(kind, path, image_size and tuple(image_size))
    slam = toolkit.build_slam(dataset, toolkit.RunSettings())
    _answer(len(dataset))
    for index, request in enumerate(sys.stdin):
        if request.strip() == "finish":
            begin = time.perf_counter()
            slam.finish()
            _answer(1e3 * (time.perf_counter() - begin))
            return
        frame = dataset[index]
        begin = time.perf_counter()
        slam.process_frame(frame)
        _answer(1e3 * (time.perf_counter() - begin))


def _answer(value: float) -> None:
    sys.stdout.write(f"answer {value}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
