"""What a user sees when something goes wrong: one line that names the remedy."""

from __future__ import annotations

import errno
import logging
import os
import sys
from collections.abc import Callable

from toolkit.errors import ToolkitError

logger = logging.getLogger(__name__)

USER_ERROR = 2
INTERRUPTED = 130  # 128 + SIGINT, as shells have it

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


def one_line_errors(job: Callable[[], int]) -> int:
    """Run a job; turn what the user can mend into one line and an exit status.

    Faults of our own (any other exception) pass through with their traceback.
    """
    try:
        status = job()
        sys.stdout.flush()  # here, where a failure is still caught
        return status
    except BrokenPipeError:
        # The reader of our output left, as in `semsplat doctor | head`. What Python
        # still holds for it must go somewhere, or it complains once more on exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except KeyboardInterrupt:
        print("semsplat: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        message = explain(error)
        if message is None:
            raise
        logger.debug("the error came from here", exc_info=True)
        print(f"semsplat: error: {message}", file=sys.stderr)
        return USER_ERROR


def explain(error: Exception) -> str | None:
    """One line with the remedy, or None where the fault is ours and not the user's."""
    if isinstance(error, ToolkitError):
        return _one_line(str(error))
    if isinstance(error, ModuleNotFoundError) and not _is_ours(error.name):
        return f"the package {error.name!r} is missing; see: semsplat doctor"
    if isinstance(error, OSError):
        return _explain_os_error(error)
    if isinstance(error, MemoryError) or _is_torch_memory_error(error):
        return "not enough memory; try a smaller --image-size or fewer frames (--max-frames)"
    return None


def _explain_os_error(error: OSError) -> str:
    reason = error.strerror or str(error) or type(error).__name__
    where = f"{error.filename}: " if error.filename else ""
    remedy = _REMEDIES.get(error.errno or 0)
    return _one_line(f"{where}{reason}" + (f"; {remedy}" if remedy else ""))


def _is_ours(module: str | None) -> bool:
    return module is None or module.split(".")[0] == "toolkit"


def _is_torch_memory_error(error: Exception) -> bool:
    # By text: the CPU allocator raises a plain RuntimeError, and torch may not be loaded.
    text = str(error)
    return isinstance(error, RuntimeError) and (
        "can't allocate memory" in text or "out of memory" in text
    )


def _one_line(text: str) -> str:
    return " ".join(text.split())
