"""Jobs that a signal ends or kills: runs save a checkpoint, other jobs are repeated."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from programs import MAIN, run, start

from toolkit.base.errors import RunFolderError, Stopped
from toolkit.runs.folder import RunFolder
from toolkit.runs.new_folder import NewFolder
from toolkit.runs.session import Session
from toolkit.runs.stopping import StopSignals
from toolkit.tools.cli.main import main

RESULTS = ("trajectory.txt", "map.ply", "loops.jsonl")


@pytest.fixture
def signalled(monkeypatch):
    """Sends a signal while a run processes frame 3."""

    def send(number: int, times: int = 1) -> None:
        process = Session._process_frame

        def interrupted(session, frame, expected):
            if frame.index == 3:
                for _ in range(times):
                    signal.raise_signal(number)
            return process(session, frame, expected)

        monkeypatch.setattr(Session, "_process_frame", interrupted)

    return send


@pytest.mark.parametrize(("number", "word"), [(signal.SIGTERM, "terminated"), (2, "interrupted")])
def test_a_signal_ends_a_run_with_a_checkpoint(
    tiny_recording, tiny_run, tmp_path, capsys, monkeypatch, signalled, number, word
):
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    words = ["run", "--dataset.kind", "folder", "--dataset.path", str(tiny_recording)]
    words += ["--out", str(tmp_path / "run")]
    signalled(number)
    assert main(words) == 128 + number
    line = capsys.readouterr().err.strip().splitlines()[-1]
    command = " ".join(["semsplat", *words, "--resume"])
    assert line == f"semsplat: {word}; a checkpoint is saved; continue with: {command}"
    saved = RunFolder(tmp_path / "run").checkpoints.load()
    assert saved is not None and saved.next_frame == 4
    monkeypatch.undo()
    assert main([*words, "--resume"]) == 0
    for name in RESULTS:
        assert (tmp_path / "run" / name).read_bytes() == (tiny_run / name).read_bytes()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def test_the_second_signal_does_not_wait(tiny_recording, tmp_path, capsys, signalled):
    words = ["run", "--dataset.kind", "folder", "--dataset.path", str(tiny_recording)]
    signalled(signal.SIGTERM, times=2)
    assert main([*words, "--out", str(tmp_path / "run")]) == 143
    assert "there is no checkpoint yet; continue with" in capsys.readouterr().err
    # The run can be started again from the folder that it left.
    assert (tmp_path / "run/config.yaml").is_file()


def test_signals_are_deferred_only_where_a_checkpoint_follows():
    before = signal.getsignal(signal.SIGTERM)  # Ray leaves one of its own
    stop = StopSignals()
    with stop.handled():
        with stop.deferred():
            signal.raise_signal(signal.SIGTERM)
        with pytest.raises(Stopped) as stopped:
            stop.check()
        assert (stopped.value.status, str(stopped.value)) == (143, "terminated")
    with StopSignals().handled(), pytest.raises(Stopped):
        signal.raise_signal(signal.SIGTERM)
    assert signal.getsignal(signal.SIGTERM) is before


def test_ignored_signals_stay_ignored():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with StopSignals().handled():
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_run_that_was_killed_while_its_folder_was_created_is_resumed(tmp_path):
    (tmp_path / ".writing-x.yaml").touch()
    folder = RunFolder.create(tmp_path, "seed: 0\n")
    folder.loops.unlink()
    folder.renders.rmdir()
    opened = RunFolder.open(tmp_path)
    opened.remove_leftovers()
    opened.prepare()
    assert opened.loops.is_file() and opened.renders.is_dir()
    assert not list(tmp_path.glob(".writing-*"))


def test_sigterm_ends_a_live_run_with_a_checkpoint(tiny_recording: Path, tmp_path: Path):
    out = tmp_path / "run"
    words = ["--camera", "replay", "--dataset.kind", "folder", "--dataset.path", tiny_recording]
    # The second frame would come after a hundred seconds.
    words += ["--fps", "0.01", "--checkpoint.every-keyframes", "1", "--out", out]
    program = _started("live", *words)
    _wait(program, out / "checkpoint/0/metadata.json")
    program.send_signal(signal.SIGTERM)
    _, errors = program.communicate(timeout=60.0)
    assert program.returncode == 143, errors
    command = f"run --config {out}/config.yaml --out {out} --resume"
    assert errors.endswith(f"a checkpoint is saved; continue with: semsplat {command}\n")
    assert main(command.split()) == 0
    states = json.loads((out / "frames.json").read_text())["states"]
    assert [state["state"] for state in states] == ["tracked"] * 6


# Arguments of each job, the function before which it is killed, and the last file that it writes.
JOBS = {
    "edit": (["--remove", "wall"], "toolkit.tools.cli.edit._report", "edit.json"),
    "refine": ([], "toolkit.runs.batch.refining.pipeline._write", "config.yaml"),
    "export": (
        ["--format", "nerfstudio"],
        "toolkit.exports.views.write_transforms",
        "transforms.json",
    ),
}
KILLED = """
import importlib, os, sys
module, _, name = sys.argv[1].rpartition(".")
setattr(importlib.import_module(module), name, lambda *_: os.kill(os.getpid(), 9))
from toolkit.tools.cli.main import main
main(sys.argv[2:])
"""


@pytest.mark.parametrize("job", JOBS)
def test_a_killed_job_is_repeated(tiny_run: Path, tmp_path: Path, capsys, job: str):
    options, function, last = JOBS[job]
    out = tmp_path / "out"
    words = [job, str(tiny_run), "--to" if job == "export" else "--out", str(out), *options]
    killed = run("-c", KILLED, function, *words)
    assert killed.returncode == -9, killed.stderr
    assert not (out / last).exists()
    (out / "notes.txt").write_text("of the user")
    (out / ".writing-x.ply").touch()
    other = ["--threads", "2"] if job == "refine" else ["--every", "2"]
    assert main([*words, *other]) == 2
    assert f"an interrupted semsplat {job} with other arguments" in capsys.readouterr().err
    assert main(words) == 0
    assert (out / last).is_file() and (out / "notes.txt").read_text() == "of the user"
    assert not [path for path in out.rglob("*") if path.name.startswith((".", "scratch"))]
    assert main(words) == 2
    assert "is not an empty folder" in capsys.readouterr().err


def test_folders_of_others_are_refused(tmp_path):
    folder = NewFolder(str(tmp_path / "out"), "edit", ("wall", 1))
    with folder.written():
        with pytest.raises(RunFolderError, match="another process"), folder.written():
            pass
        (tmp_path / "out/map.ply").touch()
    assert os.listdir(tmp_path / "out") == ["map.ply"]
    with pytest.raises(RunFolderError, match="not an empty folder"):
        folder.check()
    with pytest.raises(KeyError), NewFolder(str(tmp_path / "new"), "edit", 1).written():
        raise KeyError
    assert not (tmp_path / "new").exists()


def _started(*words: object) -> subprocess.Popen[str]:
    return start("-m", MAIN, *words, stdout=subprocess.DEVNULL)


def _wait(program: subprocess.Popen[str], path: Path) -> None:
    """Wait until a process has written a file."""
    deadline_s = time.monotonic() + 60.0
    while not path.exists():
        assert program.poll() is None and time.monotonic() < deadline_s
        time.sleep(0.002)
