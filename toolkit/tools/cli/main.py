"""`semsplat JOB ...`: entry point of all jobs.

A job is a module of this package with a function `main`, which returns the exit status. `main`
takes the arguments declared in `programs.py`, or the command line if the job is not declared there.
The module is imported after its arguments have been parsed, because it may load torch, which takes
seconds. `semsplat doctor` works on machines where most packages are missing.
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Sequence
from typing import Any

from toolkit.base.printable import PrintableFormatter
from toolkit.base.version import __version__
from toolkit.tools.cli.errors import one_line_errors

# Job: module of this package, description.
JOBS = {
    "run": ("run", "track and map a dataset, evaluate the result and write a run folder"),
    "live": ("live", "track and map the frames of a depth camera while they arrive"),
    "run-many": ("run_many", "execute many runs (sequences x settings x seeds) of a plan"),
    "refine": ("refine", "refine the map of a finished run, here or on a cluster"),
    "evaluate": ("evaluate", "evaluate a finished run again"),
    "render": ("render", "render views of a map to PNG, or a video"),
    "export": ("export", "write a map for other programs: splats, mesh, points, COLMAP, grid, ..."),
    "view": ("view", "show a map in the browser"),
    "edit": ("edit", "remove, keep, move or recolour classes of a labelled map"),
    "compare": ("compare", "compare runs on one HTML page"),
    "explain-loops": ("explain_loops", "draw the loop candidates of a run and their results"),
    "register": ("register", "register the maps of two runs and merge them"),
    "query": ("query", "count, locate and measure the objects of a labelled map"),
    "embed-objects": ("embed_objects", "embed objects with CLIP or SigLIP for queries by text"),
    "serve": ("serve", "serve a run over HTTP, or its objects, rooms and paths to assistants"),
    "check-data": ("check_data", "read a dataset and report its defects"),
    "make-room": ("make_room", "create a synthetic room with ground truth"),
    "build-taxonomy": ("build_taxonomy", "build a taxonomy from class names"),
    "train-head": ("train_head", "learn classes of your own from labelled frames"),
    "doctor": ("doctor", "report missing packages and libraries and how to install them"),
}

_USAGE = "usage: semsplat [--help] [--version] [--verbose] JOB ..."


def main(argv: Sequence[str] | None = None) -> int:
    """Run one job and return its exit status.

    Args:
        argv: command line without the program's name; that of this process by default.

    Returns:
        0 on success, 2 for an error that the user can fix (reported in one line on stderr),
        130 when interrupted, 143 when terminated. Jobs may return other values.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    verbose = "--verbose" in arguments
    arguments = [argument for argument in arguments if argument != "--verbose"]
    return one_line_errors(lambda: _started(arguments, verbose))


def _started(arguments: list[str], verbose: bool) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        print(_help())
        return 0 if arguments else 2
    if arguments[0] == "--version":
        print(f"semsplat {__version__}")
        return 0
    _set_up_logging(verbose)
    return _run_job(arguments[0], arguments[1:])


def _run_job(job: str, argv: list[str]) -> int:
    if job not in JOBS:
        print(
            f"semsplat: error: there is no job {job!r}; the jobs are: {', '.join(JOBS)}",
            file=sys.stderr,
        )
        return 2
    if {"-h", "--help", "--help-all"} & set(argv) and _print_help(job, argv):
        return 0
    arguments: Any = argv if job == "doctor" else _parsed(job, argv)
    module = importlib.import_module(f"toolkit.tools.cli.{JOBS[job][0]}")
    return int(module.main(arguments))


def _parsed(job: str, argv: list[str]) -> Any:
    """Parse and check the arguments of a job; return those of undeclared jobs unchanged."""
    # Imported here because tyro may be missing where `doctor` runs.
    from toolkit.tools.cli.arguments import parse_arguments
    from toolkit.tools.cli.checks import check_arguments
    from toolkit.tools.cli.programs import PROGRAMS

    if job not in PROGRAMS:
        return argv
    arguments: Any = parse_arguments(PROGRAMS[job], argv, job)
    check_arguments(arguments)
    return arguments


def _print_help(job: str, argv: list[str]) -> bool:
    """Print the help page of a job without importing its module; return whether it has one."""
    from toolkit.tools.cli.help import help_page
    from toolkit.tools.cli.live import LiveProgram
    from toolkit.tools.cli.programs import PROGRAMS
    from toolkit.tools.cli.run import RunProgram

    kind = (PROGRAMS | {"run": RunProgram, "live": LiveProgram}).get(job)
    if kind is not None:
        print(help_page(kind, job, "--help-all" in argv), end="")
    return kind is not None


def _help() -> str:
    width = max(map(len, JOBS))
    jobs = "\n".join(f"  {job:<{width}}  {description}" for job, (_, description) in JOBS.items())
    return (
        f"{_USAGE}\n\nSemantic 3D Gaussian Splatting SLAM.\n\njobs:\n{jobs}\n\n"
        "`semsplat JOB --help` lists the options of a job. All jobs accept --verbose.\n"
    )


def _set_up_logging(verbose: bool) -> None:
    """Log the toolkit's messages to stderr; with `verbose`, also debug messages and their origin.

    Messages of other libraries are logged from level WARNING.
    """
    layout = "%(asctime)s %(levelname)s %(name)s: %(message)s" if verbose else "%(message)s"
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(PrintableFormatter(layout))
    logging.basicConfig(level=logging.WARNING, handlers=[handler])
    logging.getLogger("toolkit").setLevel(logging.DEBUG if verbose else logging.INFO)


if __name__ == "__main__":
    sys.exit(main())
