"""What the layers of a USD file contain and refer to, before they are composed.

Composition opens every file that a layer names, and repeats what references repeat: a few nested
ones make more prims than any computer can hold. OpenUSD crashes while it reads damaged binary
files, or allocates what they state. Layers are therefore read in a process of their own first.
"""

from __future__ import annotations

import contextlib
import functools
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from toolkit.io.guarded.content import DamagedError, read_content

# Prims of a composed stage, and layers that it consists of.
_MAX_PRIMS, _MAX_LAYERS = 1_000_000, 1000
# Of the process that reads them: for small files, and for each byte of large ones.
_ANY_BYTES, _BYTES_PER_BYTE = 2**31, 16
_ANY_S, _BYTES_PER_S = 20.0, 5e6
_REFUSED = 65
_PROGRAM = """
import sys, pxr.Sdf, pxr.Tf
from toolkit.io.usd_layers import check_here
sys.exit(check_here(pxr))
"""


def check_layers(path: Path) -> None:
    """Check the layers that a file consists of.

    Raises:
        OSError: it cannot be read.
        DamagedError: one cannot be read or lies outside of the folder of the file; or they make
            too many prims, or refer to themselves.
    """
    status = path.stat()
    _checked(path.resolve(), status.st_size, status.st_mtime_ns)


@functools.lru_cache(1)
def _checked(path: Path, size: int, _: int) -> None:
    """Check a file in another process, once until it is changed."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    limit = str(_ANY_BYTES + _BYTES_PER_BYTE * size)
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _PROGRAM, str(path), limit],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=_ANY_S + size / _BYTES_PER_S,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise DamagedError("it takes too long") from error
    if done.returncode == _REFUSED:
        raise DamagedError(done.stdout.decode("utf-8", "replace"))
    if done.returncode:
        raise DamagedError("OpenUSD crashes while it reads it")


def check_here(pxr: Any) -> int:
    """Check the file that this process is given, with the memory that it is given.

    Returns:
        The status of the process.
    """
    with contextlib.suppress(ImportError):  # on Windows
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(sys.argv[2]),) * 2)
    try:
        _check(pxr, Path(sys.argv[1]))
    except DamagedError as error:
        return _refused(str(error))
    except OSError as error:
        return _refused(f"{Path(error.filename or '').name}: {error.strerror}")
    except (pxr.Tf.ErrorException, RuntimeError):
        return _refused("it is no USD file, or is damaged")
    return 0


def _refused(reason: str) -> int:
    """Tell the other process, and return the status of this one."""
    sys.stdout.buffer.write(reason.encode("utf-8", "replace"))
    return _REFUSED


def _check(pxr: Any, path: Path) -> None:
    layers = _Layers(pxr, path)
    root = layers.opened(str(path), None)
    count = sum(layers.prims(root, prim) for prim in root.rootPrims)
    if count > _MAX_PRIMS:
        raise DamagedError(f"it makes more than {_MAX_PRIMS:,} prims")


class _Layers:
    """The layers of a file, each opened once."""

    def __init__(self, pxr: Any, path: Path) -> None:
        self._sdf, self._path = pxr.Sdf, path
        self._opened: dict[str, Any] = {}
        self._prims: dict[tuple[str, str], int] = {}

    def opened(self, name: str, beside: Any) -> Any:
        """The layer of a name in another layer, with those that are merged into it."""
        where = name if beside is None else beside.ComputeAbsolutePath(name)
        if where in self._opened:
            return self._opened[where]
        # Names without ./ that are not found stay as they are.
        file = (self._path.parent / where.partition("[")[0]).resolve()
        if file != self._path and self._path.parent not in file.parents:
            raise DamagedError(f"it refers to {name!r}, outside of its folder")
        if len(self._opened) >= _MAX_LAYERS:
            raise DamagedError(f"it consists of more than {_MAX_LAYERS} files")
        if beside is not None:
            read_content(file)
        layer = self._sdf.Layer.FindOrOpen(where)
        if layer is None:
            raise DamagedError(f"{name!r} cannot be read")
        self._opened[where] = layer
        _read_values(self._sdf, layer)
        for other in layer.subLayerPaths:
            self.opened(other, layer)
        return layer

    def prims(self, layer: Any, prim: Any) -> int:
        """An upper limit of the prims that a prim of a layer makes."""
        key = layer.identifier, str(prim.path)
        if self._prims.get(key) == 0:
            raise DamagedError(f"{prim.path} refers to itself")
        if key not in self._prims:
            self._prims[key] = 0  # until it is counted
            inner = sum(self.prims(*each) for each in self._parts(layer, prim))
            self._prims[key] = min(1 + inner, _MAX_PRIMS + 1)
        return self._prims[key]

    def _parts(self, layer: Any, prim: Any) -> Iterator[tuple[Any, Any]]:
        """The children of a prim in all variants, and the prims that it repeats, by layer."""
        yield from ((layer, child) for child in prim.nameChildren)
        for variants in prim.variantSets.values():
            yield from ((layer, variant.primSpec) for variant in variants.variants.values())
        for references in (prim.referenceList, prim.payloadList):
            for reference in references.GetAddedOrExplicitItems():
                other = self.opened(reference.assetPath, layer) if reference.assetPath else layer
                yield from self._at(other, reference.primPath or f"/{other.defaultPrim}")
        for paths in (prim.inheritPathList, prim.specializesList):
            for path in paths.GetAddedOrExplicitItems():
                yield from self._at(layer, path)

    def _at(self, layer: Any, path: Any) -> Iterator[tuple[Any, Any]]:
        """A prim by its path, in a layer and in those that are merged into it."""
        found = layer.GetPrimAtPath(path)
        if found is not None:
            yield layer, found
        for name in layer.subLayerPaths:
            yield from self._at(self.opened(name, layer), path)


def _read_values(sdf: Any, layer: Any) -> None:
    """Read the values of a layer, which are decoded only now."""

    def read(path: Any) -> None:
        spec = layer.GetObjectAtPath(path)
        for key in spec.ListInfoKeys() if spec else ():
            with contextlib.suppress(TypeError):  # it is decoded, but no Python value
                spec.GetInfo(key)
        for time in layer.ListTimeSamplesForPath(path):
            layer.QueryTimeSample(path, time)

    layer.Traverse(sdf.Path.absoluteRootPath, read)
