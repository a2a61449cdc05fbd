"""Identity of the weights of a model."""

from __future__ import annotations

import hashlib
from pathlib import Path

_SUFFIXES = (".safetensors", ".bin", ".pt", ".pth", ".ckpt")
_BLOCK = 1 << 20


def sha256_of(path: Path) -> str | None:
    """Hash of a file with weights, or of all such files in a folder by name; None without any."""
    files = [path]
    if path.is_dir():
        files = sorted(f for f in path.iterdir() if f.suffix in _SUFFIXES)
    if not files or not files[0].is_file():
        return None
    digest = hashlib.sha256()
    for file in files:
        with file.open("rb") as content:
            while block := content.read(_BLOCK):
                digest.update(block)
    return digest.hexdigest()
