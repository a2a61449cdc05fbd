"""Programs of other source trees, whose packages may have other names."""

from __future__ import annotations

from pathlib import Path

from benchmarks.programs import _program, semsplat_of


def test_the_command_is_that_which_the_tree_declares(checkout: Path, tmp_path: Path) -> None:
    assert _program(checkout) == "toolkit.tools.cli.main"
    entry = "[options.entry_points]\nconsole_scripts =\n    semsplat = toolkit.cli.main:main\n"
    (tmp_path / "setup.cfg").write_text(entry)
    assert _program(tmp_path) == "toolkit.cli.main"


def test_it_is_executed_with_the_code_of_the_tree(checkout: Path) -> None:
    done = semsplat_of(checkout, "--version")
    assert done.returncode == 0 and done.stdout.startswith("semsplat ")
