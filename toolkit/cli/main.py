"""`semsplat JOB ...`: the one entrance to all programs.

A job is a module of this package with `main(argv) -> int`. It is imported only when
it is asked for, so that `semsplat --help` is instant and `semsplat doctor` works on a
machine where half of the packages are missing.
"""

from __future__ import annotations

import importlib
import logging
import sys
from collections.abc import Sequence

from toolkit import __version__
from toolkit.cli.errors import one_line_errors

# Job: module of this package, what it does.
JOBS = {
    "run": ("run", "track and map a data set, evaluate, leave a run folder"),
    "evaluate": ("evaluate", "measure a run folder again"),
    "render": ("render", "render views of a map to PNG"),
    "export": ("export", "write a map as .ply, .splat, .spz, mesh or point cloud"),
    "explain-loops": ("explain_loops", "draw each suspected loop of a run and its verdict"),
    "register": ("register", "find where one run's map lies in another's, and merge the two"),
    "query": ("query", "ask a labelled map what is where, how many and how large"),
    "check-data": ("check_data", "read a data set and say what is wrong with it"),
    "make-room": ("make_room", "make a synthetic room with known truth"),
    "build-taxonomy": ("build_taxonomy", "sort class names into a tree of groups"),
    "train-head": ("train_head", "train a segmentation head on a data set's labels"),
    "doctor": ("doctor", "say what this machine has, and how to mend what it lacks"),
}

_USAGE = "usage: semsplat [--help] [--version] [--verbose] JOB ..."


def main(argv: Sequence[str] | None = None) -> int:
    """Run one job and return its exit status.

    Args:
        argv: the words after the program's name; those of this process by default.

    Returns:
        0 on success, 2 where the user can mend it (one line on stderr says how),
        130 when interrupted; a job may return others of its own.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    verbose = "--verbose" in words
    words = [word for word in words if word != "--verbose"]
    if not words or words[0] in ("-h", "--help"):
        print(_help())
        return 0 if words else 2
    if words[0] == "--version":
        print(f"semsplat {__version__}")
        return 0
    _set_up_logging(verbose)
    return one_line_errors(lambda: _run_job(words[0], words[1:]))


def _run_job(job: str, argv: list[str]) -> int:
    if job not in JOBS:
        print(
            f"semsplat: error: there is no job {job!r}; the jobs are: {', '.join(JOBS)}",
            file=sys.stderr,
        )
        return 2
    if {"-h", "--help", "--help-all"} & set(argv) and _print_help(job, argv):
        return 0
    module = importlib.import_module(f"toolkit.cli.{JOBS[job][0]}")
    return int(module.main(argv))


def _print_help(job: str, argv: list[str]) -> bool:
    """Print the help of a job without importing what it needs to run, if it has any."""
    from toolkit.cli.help import help_page
    from toolkit.cli.programs import PROGRAMS
    from toolkit.cli.run import RunProgram

    kind = (PROGRAMS | {"run": RunProgram}).get(job)
    if kind is not None:
        print(help_page(kind, job, "--help-all" in argv), end="")
    return kind is not None


def _help() -> str:
    width = max(map(len, JOBS))
    jobs = "\n".join(f"  {job:<{width}}  {meaning}" for job, (_, meaning) in JOBS.items())
    return (
        f"{_USAGE}\n\nSemantic 3D Gaussian Splatting SLAM.\n\njobs:\n{jobs}\n\n"
        "`semsplat JOB --help` lists the options of a job. --verbose may be given anywhere.\n"
    )


def _set_up_logging(verbose: bool) -> None:
    """The toolkit's messages to stderr; with `verbose` every detail, with its origin."""
    layout = "%(asctime)s %(levelname)s %(name)s: %(message)s" if verbose else "%(message)s"
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format=layout)
    logging.getLogger("toolkit").setLevel(logging.DEBUG if verbose else logging.INFO)


if __name__ == "__main__":
    sys.exit(main())
