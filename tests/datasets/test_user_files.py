"""Recordings as other systems leave them: hidden files beside their own, and marked text files."""

import codecs

import numpy as np
import pytest

from toolkit.datasets.registry import open_dataset
from toolkit.io.user_files import read_text, visible

KINDS = {
    "folder": "make_folder",
    "nerfstudio": "make_nerfstudio",
    "polycam": "make_polycam",
    "replica": "make_replica",
    "scannet": "make_scannet",
    "seven-scenes": "make_seven_scenes",
    "stray-scanner": "make_stray_scanner",
    "tum": "make_tum",
}


def leave_traces(folder):
    """What macOS adds to every file and folder on foreign disks, and Windows to folders."""
    for place in [folder, *(path for path in folder.rglob("*") if path.is_dir())]:
        for file in [path for path in place.iterdir() if path.is_file()]:
            (place / f"._{file.name}").write_bytes(b"\x00\x05\x16\x07Mac OS X")
        for name in (".DS_Store", "Thumbs.db", "desktop.ini"):
            (place / name).write_bytes(b"\x00\x01")
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX/._a.png").write_bytes(b"\x00\x05\x16\x07")


def save_as_windows_does(folder):
    """Texts with a byte order mark and CRLF."""
    for file in folder.rglob("*"):
        if file.suffix in (".txt", ".json", ".yaml", ".csv") and not file.name.startswith("."):
            lines = file.read_bytes().replace(b"\r\n", b"\n").replace(b"\n", b"\r\n")
            file.write_bytes(codecs.BOM_UTF8 + lines)


@pytest.mark.parametrize("change", [leave_traces, save_as_windows_does])
@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_is_read_as_before(kind, change, request):
    folder = request.getfixturevalue(KINDS[kind])()
    before = open_dataset(kind, folder)
    change(folder)
    after = open_dataset(kind, folder)
    assert len(after) == len(before) > 0
    assert after.camera == before.camera
    assert after.recording.notes == before.recording.notes
    assert after.recording.flaws == before.recording.flaws
    last = len(before) - 1
    for index in (0, last):
        assert after[index].timestamp_s == before[index].timestamp_s
        np.testing.assert_array_equal(after[index].rgb, before[index].rgb)
        np.testing.assert_array_equal(after[index].depth_m, before[index].depth_m)
    truth = [
        None if d.ground_truth is None else d.ground_truth.T_world_camera for d in (before, after)
    ]
    np.testing.assert_array_equal(truth[0], truth[1])


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_texts_are_read_in_the_encoding_of_their_mark(tmp_path, encoding):
    file = tmp_path / "a.txt"
    file.write_text("Möbel\n", encoding=encoding)
    assert read_text(file) == "Möbel\n"


def test_hidden_entries_are_not_visible(tmp_path):
    for name in ("b.png", "a.png", "._a.png", ".DS_Store", "Thumbs.db", "desktop.ini"):
        (tmp_path / name).touch()
    assert [path.name for path in visible(tmp_path)] == ["a.png", "b.png"]
