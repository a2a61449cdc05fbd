"""Error messages of the command line: one line that names the remedy."""

from __future__ import annotations

import contextlib
import errno
import io
import logging
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from toolkit.base.errors import DependencyError, SettingsError, Stopped, ToolkitError
from toolkit.base.printable import PrintableStream, printable

logger = logging.getLogger(__name__)

USER_ERROR = 2
INTERRUPTED = 130  # 128 + SIGINT, as in shells

_REMEDIES = {
    errno.ENOSPC: "free some space or write elsewhere",
    errno.EDQUOT: "free some space or write elsewhere",
    errno.EACCES: "choose a path that you may read and write",
    errno.EPERM: "choose a path that you may read and write",
    errno.EROFS: "choose a path on a disk that can be written to",
    errno.ENOENT: "check the path",
    errno.ENOTDIR: "check the path",
    errno.EISDIR: "name a file, not a folder",
    errno.EMFILE: "raise the limit with: ulimit -n 4096",
}

_THREADS = "OMP_NUM_THREADS"

# What the loader of libraries reports if memory is limited.
_NO_ADDRESSES = ("failed to map segment", "annot allocate memory")


def one_line_errors(job: Callable[[], int]) -> int:
    """Run a job; report errors that the user can fix in one line and return the exit status.

    Other exceptions are programming errors and propagate with their traceback. Characters that the
    encoding of stdout or stderr lacks are printed as escapes.
    """
    _open_standard_streams()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    # Names in files may contain sequences that control the terminal.
    shown: Any = PrintableStream(sys.stdout)
    try:
        with contextlib.redirect_stdout(shown):
            _check_environment()
            status = job()
        sys.stdout.flush()  # errors of flushing are caught here
        return status
    except Stopped as stopped:
        print(f"semsplat: {printable(str(stopped))}", file=sys.stderr)
        return stopped.status
    except KeyboardInterrupt:
        print("semsplat: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if _is_broken_pipe(error):
            # The reader of stdout has exited, as in `semsplat doctor | head`. Redirect buffered
            # output, or Python reports the error again at exit.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        message = explain(error)
        if message is None:
            raise
        logger.debug("Traceback of the error:", exc_info=True)
        print(f"semsplat: error: {message}", file=sys.stderr)
        return USER_ERROR


def _is_broken_pipe(error: BaseException) -> bool:
    """Whether nothing but that went wrong; concurrent tasks raise groups."""
    if isinstance(error, BaseExceptionGroup):
        return all(map(_is_broken_pipe, error.exceptions))
    return isinstance(error, BrokenPipeError)


def _open_standard_streams() -> None:
    """Replace streams that are closed, as those of daemons: a file would take their place."""
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest number that is free
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115


def _check_environment() -> None:
    """Check what libraries take from the environment, and end the process or raise over."""
    threads = os.environ.get(_THREADS, "1")
    if not threads.strip().isdecimal() or int(threads) < 1:
        raise SettingsError(
            f"{_THREADS} is {threads!r}; set it to a number of threads, or remove it: "
            f"unset {_THREADS}"
        )
    try:
        Path.cwd()
    except OSError as error:
        raise SettingsError(
            f"the working folder cannot be used ({error.strerror}); change to another one with cd"
        ) from error


def explain(error: Exception) -> str | None:
    """Return one line with the remedy, or None for programming errors."""
    is_library = isinstance(error, (ImportError, DependencyError))
    if is_library and any(text in str(error) for text in _NO_ADDRESSES):
        return "a library cannot be loaded in the memory that is left; raise the limit: ulimit -v"
    if isinstance(error, ToolkitError):
        return _one_line(str(error))
    if isinstance(error, ModuleNotFoundError) and not _is_own_module(error.name):
        return f"the package {error.name!r} is missing; see: semsplat doctor"
    if isinstance(error, OSError):
        return _explain_os_error(error)
    if isinstance(error, UnicodeEncodeError) and _is_undecoded(error.object[error.start]):
        name = _one_line(error.object)
        return f"a library needs names in UTF-8, not {name}; set the locale: export LC_ALL=C.UTF-8"
    if isinstance(error, MemoryError) or _is_torch_memory_error(error):
        return (
            "not enough memory; close other programs or raise the limit (ulimit -v); runs need "
            "less with a smaller --image-size or fewer frames (--max-frames)"
        )
    return None


def _explain_os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    where = f"{error.filename}: " if error.filename else ""
    remedy = _REMEDIES.get(error.errno or 0)
    return _one_line(f"{where}{reason}" + (f"; {remedy}" if remedy else ""))


def _is_undecoded(character: str) -> bool:
    """Whether a character stands for a byte of a file's name that the locale cannot decode."""
    return "\udc80" <= character <= "\udcff"


def _is_own_module(module: str | None) -> bool:
    return module is None or module.split(".")[0] == "toolkit"


def _is_torch_memory_error(error: Exception) -> bool:
    # Recognised by text: the CPU allocator raises RuntimeError, and torch may not be loaded.
    text = str(error)
    return isinstance(error, RuntimeError) and (
        "can't allocate memory" in text or "out of memory" in text
    )


def _one_line(text: str) -> str:
    return printable(" ".join(text.split()))
