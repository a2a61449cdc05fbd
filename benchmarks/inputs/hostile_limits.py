"""Calls a reader in a process of its own, with limits of time and memory, and judges messages."""

from __future__ import annotations

import faulthandler
import json
import os
import resource
import select
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from benchmarks.inputs.hostile_samples import RefusedError
from toolkit.base.errors import ToolkitError

MAX_S, MAX_BYTES = 25.0, 2 * 2**30
# Of a message: more is a part of the file.
_MAX_MESSAGE = 600
# Address space beyond that at the start: a reader that needs more would harm the machine.
_ADDRESSES = 4 * 2**30
# A process that has used less than this share of the time waits for something that does not come;
# others may be slowed down by other work, up to this factor.
_BUSY, _WAITS = 0.1, 6
_PAGE = resource.getpagesize()


def message_fault(message: str, names: list[str]) -> str:
    """What is wrong with a message about a file of one of these names; empty if nothing is."""
    if "\n" in message.strip():
        return "a message of several lines"
    if not message.isprintable():
        return "control characters in a message"
    if len(message) > _MAX_MESSAGE:
        return "a long message"
    if not any(name in message for name in names if name):
        return "a message that does not name the file"
    return ""


@dataclass(frozen=True)
class Limited:
    """What a call in a process of its own did.

    Attributes:
        fault: why it failed; empty if it passed.
        message: of the error, if any.
        seconds: of CPU time, which other work on the machine does not prolong.
        memory_mb: growth of the process.
    """

    fault: str
    message: str
    seconds: float
    memory_mb: float


def limited(call: Callable[[], object]) -> Limited:
    """Call in a process of its own, with limits of time and memory."""
    reading, writing = os.pipe()
    process = os.fork()
    if process == 0:
        os.close(reading)
        _child(call, writing)
    os.close(writing)
    handle = os.pidfd_open(process)
    ended = _ends(process, handle)
    if not ended:
        os.kill(process, signal.SIGKILL)
    _, status, usage = os.wait4(process, 0)
    os.close(handle)
    with os.fdopen(reading, "rb") as stream:
        said = {k: v for line in stream for k, v in json.loads(line).items()}
    seconds = usage.ru_utime + usage.ru_stime
    grown = 1024 * usage.ru_maxrss - said.get("start_bytes", 1024 * usage.ru_maxrss)
    fault, message = said.get("fault", ""), said.get("message", "")
    if not ended:
        fault = f"more than {MAX_S:.0f} s"
    elif os.WIFSIGNALED(status):
        fault = f"signal {signal.Signals(os.WTERMSIG(status)).name}"
    elif os.WEXITSTATUS(status):
        fault = f"exit status {os.WEXITSTATUS(status)}"
    elif grown > MAX_BYTES:
        fault = "more than 2 GB"
    return Limited(fault, message, round(seconds, 2), round(grown / 2**20))


def _ends(process: int, handle: int) -> bool:
    """Wait until a process ends; False if it takes too long, or waits for something itself."""
    begin = time.monotonic()
    while time.monotonic() - begin < _WAITS * MAX_S:
        if select.select([handle], [], [], MAX_S)[0]:
            return True
        times = Path(f"/proc/{process}/stat").read_text("utf-8").rpartition(")")[2].split()
        seconds = (int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK")
        if seconds > MAX_S or seconds < _BUSY * (time.monotonic() - begin):
            return False
    return False


def _child(call: Callable[[], object], writing: int) -> None:
    """Make the call, and say what it raised."""
    status = 70
    try:
        faulthandler.disable()
        quiet = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(quiet, stream)
        os.write(writing, json.dumps({"start_bytes": _resident_bytes()}).encode() + b"\n")
        os.write(writing, json.dumps(_said(call)).encode())
        status = 0
    finally:
        os._exit(status)


def _said(call: Callable[[], object]) -> dict[str, str]:
    limit = _PAGE * int(Path("/proc/self/statm").read_text("utf-8").split()[0]) + _ADDRESSES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    try:
        call()
    except (ToolkitError, RefusedError) as error:
        return {"message": str(error)[:4096]}
    except MemoryError:
        return {"fault": "more than 2 GB"}
    except BaseException as error:  # noqa: BLE001 - whatever a reader raises is counted
        frame = error.__traceback__
        while frame is not None and frame.tb_next is not None:
            frame = frame.tb_next
        place = "" if frame is None else Path(frame.tb_frame.f_code.co_filename).name
        return {"fault": f"{type(error).__name__} in {place}", "message": str(error)[:300]}
    return {}


def _resident_bytes() -> int:
    return _PAGE * int(Path("/proc/self/statm").read_text("utf-8").split()[1])
