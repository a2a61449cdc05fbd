"""One process writes a run folder; another one ends at once, and death releases the folder."""

import errno
import signal
import subprocess
import sys

import pytest
from filelock import FileLock

from toolkit.base.errors import RunFolderError
from toolkit.runs.lock import locked

HOLD = """
import sys, time
from pathlib import Path
from toolkit.runs.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def test_a_held_folder_is_refused_and_afterwards_free(tmp_path):
    with (
        locked(tmp_path),
        pytest.raises(RunFolderError, match="another process is running in"),
        locked(tmp_path),
    ):
        raise AssertionError("held twice")
    with locked(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_folder_that_cannot_be_locked_is_used_without_a_lock(tmp_path, monkeypatch):
    def acquire(self):
        raise PermissionError(errno.EACCES, "no permission")

    monkeypatch.setattr(FileLock, "acquire", acquire)
    with locked(tmp_path), locked(tmp_path):
        pass


def test_a_process_waits_for_the_end_of_another(tmp_path):
    command = [sys.executable, "-c", HOLD.replace("60", "1"), str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(RunFolderError), locked(tmp_path):
            pass
        with locked(tmp_path, patience_s=60.0):
            pass


def test_the_death_of_the_holder_releases_the_folder(tmp_path):
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    with pytest.raises(RunFolderError), locked(tmp_path):
        pass
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    holder.stdout.close()
    with locked(tmp_path):
        pass
