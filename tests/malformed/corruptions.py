"""Ways to damage a file, by name."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

Corruption = Callable[[Path], None]


def content(data: bytes) -> Corruption:
    """Replace the content of the file."""
    return lambda path: _write(path, data)


def text(data: str) -> Corruption:
    """Replace the content of the file by text."""
    return content(data.encode())


def edit(old: str, new: str) -> Corruption:
    """Replace a part of a text file, which must be there."""

    def apply(path: Path) -> None:
        before = path.read_bytes()
        assert old.encode() in before, f"{path.name} does not contain {old!r}"
        path.write_bytes(before.replace(old.encode(), new.encode(), 1))

    return apply


def json_value(*keys: str | int, value: Any) -> Corruption:
    """Set a value of a JSON file."""

    def apply(path: Path) -> None:
        root = json.loads(path.read_text(encoding="utf-8"))
        place = root
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value
        path.write_text(json.dumps(root), encoding="utf-8")

    return apply


def without_key(*keys: str | int) -> Corruption:
    """Remove a key of a JSON file."""

    def apply(path: Path) -> None:
        root = json.loads(path.read_text(encoding="utf-8"))
        place = root
        for key in keys[:-1]:
            place = place[key]
        del place[keys[-1]]
        path.write_text(json.dumps(root), encoding="utf-8")

    return apply


def array(name: str, change: Callable[[np.ndarray], np.ndarray] | None) -> Corruption:
    """Change an array of an .npz file, or remove it."""

    def apply(path: Path) -> None:
        with np.load(path) as file:
            arrays = {key: file[key] for key in file.files}
        before = arrays.pop(name)
        if change is not None:
            arrays[name] = change(before)
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        path.write_bytes(buffer.getvalue())

    return apply


def image(pixels: np.ndarray) -> Corruption:
    """Replace an image by other pixels, BGR or grey."""
    encoded = cv2.imencode(".png", pixels)[1].tobytes()
    return content(encoded)


def _write(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def _missing(path: Path) -> None:
    shutil.rmtree(path) if path.is_dir() else path.unlink()


def _truncated(path: Path) -> None:
    before = path.read_bytes()
    path.write_bytes(before[: len(before) // 2])


def _directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


def _file(path: Path) -> None:
    shutil.rmtree(path)
    path.write_bytes(b"no folder")


GARBAGE = bytes(np.random.default_rng(0).integers(0, 256, 400, np.uint8))

ANY_FILE: dict[str, Corruption] = {
    "missing": _missing,
    "empty": content(b""),
    "truncated": _truncated,
    "garbage": content(GARBAGE),
    "directory": _directory,
}
TEXT_FILE = ANY_FILE | {"not UTF-8": content("é: 1\n".encode("latin-1"))}
JSON_FILE = TEXT_FILE | {"a list": text("[1]"), "a number": text("7"), "NaN": text("NaN")}
FOLDER: dict[str, Corruption] = {"missing": _missing, "file": _file}
