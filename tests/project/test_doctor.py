"""`semsplat doctor`: names what is there, and the line that mends what is not."""

import pytest
from programs import semsplat

from toolkit.base import native
from toolkit.tools.cli import doctor


def test_the_launcher_prints_a_line_for_each_part_of_the_machine():
    result = semsplat("doctor")
    assert result.stderr == ""
    for subject in ("instruction set", "native kernels", "threads", "gpu", "open3d", "gtsam"):
        assert f"\n{subject} " in result.stdout
    missing = "\nmissing: " in result.stdout
    assert result.returncode == (1 if missing else 0)


@pytest.fixture
def without_open3d(monkeypatch):
    """Spares the seconds that loading Open3D takes."""
    monkeypatch.setattr(doctor, "_open3d_findings", lambda: iter(()))


def test_a_forced_instruction_set_that_is_not_there_is_reported(
    without_open3d, monkeypatch, capsys
):
    if not native.available_instruction_sets():
        pytest.skip("the native kernels are not built")
    monkeypatch.setenv("SEMSPLAT_ISA", "mmx")
    native.kernels.cache_clear()
    assert doctor.main([]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert any("SEMSPLAT_ISA=mmx: instruction set 'mmx' is unknown" in line for line in lines)
    assert lines[-1] == "missing: native kernels"
    assert any(line.strip() == "fix it with: unset SEMSPLAT_ISA" for line in lines)


def test_missing_packages_come_with_the_line_that_mends_them(without_open3d, monkeypatch, capsys):
    monkeypatch.setitem(doctor._REQUIRED, "no_such_module", "some-package")
    monkeypatch.setitem(doctor._OPTIONAL, "no_such_extra", ("other-package", "nothing"))
    assert doctor.main([]) == 1
    printed = capsys.readouterr().out
    assert "fix it with: pip install some-package\n" in printed
    assert "fix it with: pip install other-package\n" in printed
    assert printed.splitlines()[-1] == "missing: some-package"


def test_a_missing_system_library_comes_with_the_line_that_mends_it(monkeypatch):
    monkeypatch.setitem(doctor._SYSTEM_LIBRARIES, "libnosuch.so.9", "libnosuch9")
    finding = doctor._system_libraries()
    assert finding.needed
    assert finding.remedy == "apt-get install -y libnosuch9"
