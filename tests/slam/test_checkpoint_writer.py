"""Checkpoints are the state at the time of saving, also when they are written later."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest

from toolkit.base.errors import RunFolderError
from toolkit.runs.checkpoint_writer import CheckpointWriter
from toolkit.runs.checkpoints import Checkpoints
from toolkit.runs.folder import RunFolder


class System:
    """A system whose state is one array."""

    def __init__(self) -> None:
        self.array = np.zeros(3)
        self.atlas = SimpleNamespace(checkpointed=lambda: None)

    def state(self):
        return {"a": self.array}, {}


@pytest.fixture
def folder(tmp_path) -> RunFolder:
    return RunFolder.create(tmp_path / "run", "seed: 0\n")


@pytest.mark.parametrize("background", [False, True])
def test_the_newest_state_is_loaded(folder, background):
    writer, system = CheckpointWriter(folder, background), System()
    for frame in range(3):
        system.array += 1
        writer.save(system, frame)
    writer.wait()
    checkpoint = folder.checkpoints.load()
    assert checkpoint.next_frame == 2
    assert checkpoint.arrays["a"].tolist() == [3.0] * 3


def test_saving_returns_before_the_state_is_written(folder, monkeypatch):
    """The state is that of the call, although the system goes on."""
    writer, system, released = (
        CheckpointWriter(folder, background=True),
        System(),
        threading.Event(),
    )
    save = folder.checkpoints.save

    def slowly(*arguments):
        assert released.wait(10)
        save(*arguments)

    monkeypatch.setattr(Checkpoints, "save", lambda _self, *a: slowly(*a))
    writer.save(system, 7)
    system.array += 5
    assert folder.checkpoints.load() is None
    released.set()
    writer.wait()
    assert folder.checkpoints.load().arrays["a"].tolist() == [0.0] * 3


@pytest.fixture
def full_disk(monkeypatch) -> None:
    def fail(*_):
        raise RunFolderError("no space left")

    monkeypatch.setattr(Checkpoints, "save", fail)


def test_a_checkpoint_that_cannot_be_written_is_an_error(folder, full_disk):
    with pytest.raises(RunFolderError, match="no space left"):
        CheckpointWriter(folder, background=False).save(System(), 0)


def test_an_error_in_the_background_is_raised_later(folder, full_disk):
    writer = CheckpointWriter(folder, background=True)
    writer.save(System(), 0)
    with pytest.raises(RunFolderError, match="no space left"):
        writer.save(System(), 1)
