"""A run is resumed with the frames that it has processed, or ends with one line."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from toolkit.base.errors import RunFolderError
from toolkit.datasets.registry import open_dataset
from toolkit.runs.processed_frames import check_identity, identity_of
from toolkit.tools.cli.main import main

FRAMES = 3


def replace_in(file: Path, old: str, new: str) -> None:
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


def remove(folder: Path, stem: str) -> None:
    for name in ("rgb", "depth", "labels"):
        (folder / name / f"{stem}.png").unlink()


def move_poses(folder: Path) -> None:
    lines = (folder / "trajectory.txt").read_text().splitlines()
    words = lines[2].split()
    words[1] = "7.5"
    (folder / "trajectory.txt").write_text("\n".join([*lines[:2], " ".join(words), *lines[3:]]))


CHANGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "depth scale": (lambda f: replace_in(f / "intrinsics.yaml", "5000", "1000"), "depth scale"),
    "principal point": (
        lambda f: replace_in(f / "intrinsics.yaml", "cx: ", "cx: 1"),
        "the camera",
    ),
    "distortion": (
        lambda f: replace_in(f / "intrinsics.yaml", "fps", "distortion: [0.1, 0, 0, 0, 0]\nfps"),
        "the camera",
    ),
    "times": (lambda f: replace_in(f / "intrinsics.yaml", "fps: 30", "fps: 15"), "names or times"),
    "a frame": (lambda f: remove(f, "0001"), "names or times"),
    "labels": (lambda f: (f / "labels" / "0001.png").unlink(), "names or times"),
    "poses": (move_poses, "poses"),
}


@pytest.fixture
def changed(tiny_recording, tmp_path) -> Path:
    """A copy of the recording that a test changes."""
    return Path(shutil.copytree(tiny_recording, tmp_path / "recording"))


def identity(folder: Path, given_poses: bool = True) -> dict[str, str]:
    return identity_of(open_dataset("folder", folder), FRAMES, given_poses)


@pytest.mark.parametrize("what", CHANGES)
def test_changes_of_processed_frames_are_named(tiny_recording, changed, what):
    change, words = CHANGES[what]
    change(changed)
    with pytest.raises(RunFolderError, match=f"cannot resume run: .*{words}"):
        check_identity(identity(tiny_recording), identity(changed), "run")


def test_later_frames_may_change(tiny_recording, changed):
    remove(changed, "0004")
    check_identity(identity(tiny_recording), identity(changed), "run")


def test_poses_that_the_run_does_not_use_may_change(tiny_recording, changed):
    move_poses(changed)
    saved = identity(tiny_recording, given_poses=False)
    check_identity(saved, identity(changed, given_poses=False), "run")


def test_a_run_is_not_resumed_with_another_camera(tiny_recording, resumable_run, tmp_path, capsys):
    place = Path(shutil.copytree(tiny_recording, tmp_path / "recording"))
    out = Path(shutil.copytree(resumable_run, tmp_path / "run"))
    replace_in(out / "config.yaml", str(tiny_recording), str(place))
    replace_in(place / "intrinsics.yaml", "5000", "4000")
    before = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    words = ["run", "--config", str(out / "config.yaml"), "--out", str(out), "--resume"]
    assert main(words) == 2
    assert "the depth scale of the dataset changed" in capsys.readouterr().err
    after = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    assert {f: c for f, c in after.items() if f.name != "log.txt"} == {
        f: c for f, c in before.items() if f.name != "log.txt"
    }
