"""Programs as processes of their own that are forked from one that has imported what they need.

A fresh interpreter spends seconds on importing torch, Open3D and others. Here it happens once per
worker of pytest: an interpreter imports the toolkit and waits, and each program is a fork of it
with its own process id, streams, signals, working folder, environment and exit status. So are the
programs that it starts. Where an environment could change an import, a fresh interpreter is
started instead.
"""

from __future__ import annotations

import atexit
import functools
import gc
import importlib
import json
import os
import pkgutil
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MAIN = "toolkit.tools.cli.main"
# Names of variables begin so that no import reads.
_READ_LATER = ("PYTEST_", "SEMSPLAT_LLM")
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_VARIABLES = {"PYTHONPATH": str(ROOT)} | dict.fromkeys(_THREADS, "1")
_AT_START = dict(os.environ)  # imports add variables
# Beside the toolkit, what its programs import when they need it.
_LIBRARIES = ("fastapi", "matplotlib.figure", "mcp.server", "openai", "uvicorn")


def start(*words: object, cwd: Path | None = None, **keywords: Any) -> subprocess.Popen[str]:
    """Start `python WORDS`; stdout and stderr are pipes unless the keywords of Popen say else.

    Args:
        env: more environment variables.
    """
    env = os.environ | _VARIABLES | keywords.pop("env", {})
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    command = [sys.executable, *map(str, words)]
    options = {"cwd": cwd or ROOT, "env": env, "text": True, "preexec_fn": _interruptible}
    return _Forked(command, **options, **streams | keywords)


def run(*words: object, **keywords: Any) -> subprocess.CompletedProcess[str]:
    """Run `python WORDS` to its end; see `start`."""
    with start(*words, **keywords) as process:
        try:
            printed = process.communicate(timeout=300)  # beside others, one needs two minutes
        finally:
            process.kill()
    return subprocess.CompletedProcess(process.args, process.returncode, *printed)


def semsplat(*words: object, **keywords: Any) -> subprocess.CompletedProcess[str]:
    """Run `semsplat WORDS` to its end; see `start`."""
    return run("-m", MAIN, *words, **keywords)


def _interruptible() -> None:
    """Undo what shells do to background jobs, and so to tests in them: they ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


class _Forked(subprocess.Popen):
    """A program of Python, forked if its environment is that of the process that forks."""

    _status: int | None = None  # a pipe that says how it ended

    def _execute_child(self, args, executable, preexec, close, keep, cwd, env, *more):
        forker = _forker()
        env = os.environ if env is None else env
        if forker is None or not forker.can_start(args, env):
            super()._execute_child(args, executable, preexec, close, keep, cwd, env, *more)
            return
        streams = p2cread, _, _, c2pwrite, _, errwrite = more[3:9]
        own = [p2cread, c2pwrite, errwrite]
        files = [number if file == -1 else file for number, file in enumerate(own)]
        request = {"words": args[1:], "cwd": str(cwd or Path.cwd()), "env": dict(env)}
        self.pid, self._status = forker.fork(request, files)
        self._child_created = True
        self._close_pipe_fds(*streams)

    def _try_wait(self, wait_flags):
        if self._status is None:
            return super()._try_wait(wait_flags)
        if not select.select([self._status], [], [], 0 if wait_flags else None)[0]:
            return 0, 0
        status = int(os.read(self._status, 32))
        os.close(self._status)
        return self.pid, status

    def _internal_poll(self, *arguments, **keywords):
        if self._status is None:
            return super()._internal_poll(*arguments, **keywords)
        if self.returncode is None:
            pid, status = self._try_wait(os.WNOHANG)
            if pid:
                self._handle_exitstatus(status)
        return self.returncode


class _Forker:
    """The process that forks, seen from a worker of pytest."""

    def __init__(self, channel: socket.socket, env: dict[str, str]) -> None:
        self._channel, self._env = channel, env

    @classmethod
    def started(cls) -> _Forker:
        channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        env = os.environ | _VARIABLES
        streams: dict[str, Any] = {"stdin": theirs, "stdout": subprocess.DEVNULL}
        with theirs:
            subprocess.Popen([sys.executable, __file__], env=env, start_new_session=True, **streams)
        return cls(channel, env)

    def can_start(self, words: Any, env: Mapping[str, str]) -> bool:
        """Whether this is a program of Python whose imports are the same in the environment."""
        if len(words) < 2 or words[0] != sys.executable or words[1].startswith("-u"):
            return False
        changed = set(env.items()) ^ set(self._env.items())
        return all(name.startswith(_READ_LATER) for name, _ in changed)

    def fork(self, request: dict[str, Any], files: list[int]) -> tuple[int, int]:
        """Return the process id, and the pipe that says how the process ended."""
        ours, theirs = os.pipe()
        files = [*files, theirs, self._channel.fileno()]
        socket.send_fds(self._channel, [json.dumps(request).encode()], files)
        os.close(theirs)
        return int(os.read(ours, 32)), ours


@functools.cache
def _forker() -> _Forker | None:
    """The process that forks for this one, started when it is first needed."""
    return _Forker.started() if sys.platform == "linux" else None


def _served() -> dict[str, Any]:
    """Fork for each request; returns the request in the process that is to fulfil it."""
    # Programs end with their own status, and whoever presses Ctrl-C means pytest.
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = socket.socket(fileno=os.dup(0))
    while True:
        request, files, *_ = socket.recv_fds(channel, 1 << 20, 5)
        if not request:
            os._exit(0)  # the worker of pytest ended
        if os.fork() == 0:
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            pid = os.fork()
            if pid == 0:
                channel.close()
                _replace_streams(files[:4])
                return json.loads(request) | {"channel": files[4]}
            for file in (*files[:3], files[4]):
                os.close(file)
            os.write(files[3], b"%d" % pid)
            os.write(files[3], b"%d" % os.waitpid(pid, 0)[1])
            os._exit(0)
        for file in files:
            os.close(file)


def _replace_streams(files: list[int]) -> None:
    for number, file in enumerate(files[:3]):
        os.dup2(file, number)
    for file in files:
        os.close(file)
    # What was opened before the fork has the properties of other files.
    text: dict[str, Any] = {"encoding": "utf-8", "closefd": False}
    sys.stdin = open(0, **text)  # noqa: SIM115
    sys.stdout = open(1, "w", **text)  # noqa: SIM115
    sys.stderr = open(2, "w", buffering=1, errors="backslashreplace", **text)  # noqa: SIM115


def _fulfil(words: list[str], cwd: str, env: dict[str, str], channel: int) -> None:
    """Do what the interpreter does with its arguments."""
    global _forker
    _interruptible()
    forker = _Forker(socket.socket(fileno=channel), _AT_START)
    _forker = lambda: forker  # noqa: E731
    subprocess.Popen = _Forked  # type: ignore[misc]
    os.environ.clear()
    os.environ.update(env)
    os.chdir(cwd)
    first, *more = words
    if first == "-m":
        sys.path[0], sys.argv = cwd, more
        sys.modules.pop(more[0], None)
        runpy.run_module(more[0], run_name="__main__", alter_sys=True)
    elif first == "-c":
        sys.path[0], sys.argv = "", ["-c", *more[1:]]
        exec(compile(more[0], "<string>", "exec"), {"__name__": "__main__"})
    else:
        sys.path[0], sys.argv = str(Path(first).parent), words
        runpy.run_path(first, run_name="__main__")


def _ended(**request: Any) -> None:
    """Fulfil a request and end, without destroying what was imported: that takes a second."""
    status: Any = 0
    try:
        _fulfil(**request)
    except SystemExit as end:
        status = end.code or 0
        if not isinstance(status, int):
            print(status, file=sys.stderr)
            status = 1
    except BaseException:  # noqa: BLE001
        sys.excepthook(*sys.exc_info())
        status = 1
    threading._shutdown()
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    os._exit(status)


def _import_all() -> None:
    import toolkit

    modules = [module.name for module in pkgutil.walk_packages(toolkit.__path__, "toolkit.")]
    for name in (*modules, *_LIBRARIES):
        try:
            importlib.import_module(name)
        except ImportError:  # optional ones
            continue


if __name__ == "__main__":
    _import_all()
    gc.freeze()
    _ended(**_served())
