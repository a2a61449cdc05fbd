"""Selection of the compiled variant of the kernels."""

from __future__ import annotations

import importlib.util
import json
import pkgutil
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from toolkit.base.errors import DependencyError
from toolkit.base.native import constants, loading
from toolkit.base.version import __version__

BUILT_BASE = loading._path("base")
AVAILABLE = loading.available_instruction_sets()
needs_kernels = pytest.mark.skipif(not AVAILABLE, reason="no native kernels were built")


class FakeVariant:
    """A variant on a CPU with AVX2, but without AVX-512."""

    def __init__(self, name: str):
        self.instruction_set = name

    def supported_instruction_sets(self) -> list[str]:
        return ["base", "avx2"]


@pytest.fixture(autouse=True)
def no_cached_choice(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Clears the cached choice of kernels before and after each test."""
    monkeypatch.delenv(loading.ISA_VARIABLE, raising=False)
    loading.kernels.cache_clear()
    yield
    loading.kernels.cache_clear()


@pytest.fixture
def variants(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that replaces the one of the compiled variants."""
    monkeypatch.setattr(loading, "_VARIANTS", tmp_path)
    monkeypatch.setattr(loading, "_load", loading._load.__wrapped__)
    return tmp_path


@pytest.fixture
def cpu_with_avx2(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "_load", FakeVariant)
    monkeypatch.setattr(loading, "built_instruction_sets", lambda: list(loading.INSTRUCTION_SETS))


@pytest.mark.parametrize("name", AVAILABLE)
def test_an_instruction_set_can_be_forced(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(loading.ISA_VARIABLE, name)
    assert loading.require_kernels().instruction_set == name


@needs_kernels
def test_the_best_available_instruction_set_is_the_default() -> None:
    assert loading.require_kernels().instruction_set == AVAILABLE[-1]


@pytest.mark.parametrize("name", ["avx9000", "AVX2", " "])
def test_unknown_instruction_set_raises(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setenv(loading.ISA_VARIABLE, name)
    with pytest.raises(DependencyError, match=f"SEMSPLAT_ISA={name}: .* is unknown; choose one of"):
        loading.kernels()


@pytest.mark.usefixtures("cpu_with_avx2")
def test_unsupported_variant_is_never_loaded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert loading.available_instruction_sets() == ["base", "avx2"]
    assert loading.require_kernels().instruction_set == "avx2"
    loading.kernels.cache_clear()
    monkeypatch.setenv(loading.ISA_VARIABLE, "avx512")
    message = "SEMSPLAT_ISA=avx512: this CPU does not support avx512; supported: base, avx2"
    with pytest.raises(DependencyError, match=message):
        loading.kernels()


def test_missing_variant_raises(monkeypatch: pytest.MonkeyPatch, variants: Path) -> None:
    assert loading.available_instruction_sets() == []
    monkeypatch.setenv(loading.ISA_VARIABLE, "avx2")
    with pytest.raises(DependencyError, match="kernels for avx2 are not built; built: none"):
        loading.kernels()


@needs_kernels
def test_damaged_variant_is_skipped_unless_forced(
    monkeypatch: pytest.MonkeyPatch, variants: Path
) -> None:
    shutil.copy(BUILT_BASE, variants)
    loading._path("avx2").write_bytes(b"not a library")
    assert loading.available_instruction_sets() == ["base"]
    monkeypatch.setenv(loading.ISA_VARIABLE, "avx2")
    with pytest.raises(DependencyError):
        loading.kernels()


@needs_kernels
def test_variant_compiled_with_other_constants_raises(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(loading, "_load", loading._load.__wrapped__)
    monkeypatch.setattr(constants, "NEAR_M", 0.02)
    with pytest.raises(DependencyError, match="compiled with other constants"):
        loading.kernels()


@needs_kernels
@pytest.mark.parametrize("name", loading.INSTRUCTION_SETS)
def test_variants_cannot_be_imported(name: str) -> None:
    assert importlib.util.find_spec(f"toolkit.base.native.variants.{name}") is None
    assert list(pkgutil.iter_modules([str(loading._path(name).parent)])) == []


@pytest.mark.parametrize(
    ("record", "origin"),
    [
        ({"url": "file:///x/semsplat-0.1.0.whl", "archive_info": {}}, ""),
        ({"url": "file:///my%20clone", "dir_info": {}}, "file:///my%20clone"),
        (
            {"url": "https://host/s.git", "vcs_info": {"vcs": "git", "commit_id": "abc"}},
            "git+https://host/s.git@abc",
        ),
        (None, f"semsplat=={__version__}"),
    ],
)
def test_outside_a_checkout_the_origin_of_the_installation_is_installed_again(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    record: dict[str, Any] | None,
    origin: str,
) -> None:
    monkeypatch.setattr(loading, "__file__", str(tmp_path / "toolkit/base/native/loading.py"))
    text = None if record is None else json.dumps(record)
    installed = SimpleNamespace(read_text=lambda name: text)
    monkeypatch.setattr(loading.metadata, "distribution", lambda name: installed)
    command = loading.rebuild_command()
    if record is not None and not origin:  # a wheel needs no compiler
        assert command == f"pip install --force-reinstall --no-deps {record['url']}"
    else:
        assert command.startswith("apt-get install -y g++ python3-dev && pip install ")
        assert command.endswith(f" --no-deps {origin}")


def test_in_a_checkout_its_folder_is_compiled() -> None:
    checkout = Path(loading.__file__).parents[3]
    assert shlex.split(loading.rebuild_command())[-2:] == ["--editable", str(checkout)]
