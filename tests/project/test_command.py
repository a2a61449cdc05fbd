"""`semsplat JOB`: dispatch, and one line for whatever a user can mend."""

import errno
import io
import os
import subprocess
import sys
import types

import pytest

import toolkit
from toolkit.base.errors import DatasetError
from toolkit.tools.cli import main as command
from toolkit.tools.cli.main import JOBS, main


@pytest.fixture
def failing_job(monkeypatch):
    """Makes `semsplat fail` raise an error, or return what is not one."""

    def install(outcome: BaseException | int) -> None:
        def job(argv: list[str]) -> int:
            if isinstance(outcome, BaseException):
                raise outcome
            return outcome

        module = types.ModuleType("toolkit.tools.cli.fail")
        module.main = job
        monkeypatch.setitem(sys.modules, "toolkit.tools.cli.fail", module)
        monkeypatch.setitem(command.JOBS, "fail", ("fail", "fails"))

    return install


def test_a_job_gets_its_words_and_gives_its_status(monkeypatch):
    received = []
    module = types.ModuleType("toolkit.tools.cli.echo")
    module.main = lambda argv: received.extend(argv) or 7
    monkeypatch.setitem(sys.modules, "toolkit.tools.cli.echo", module)
    monkeypatch.setitem(command.JOBS, "echo", ("echo", "repeats"))
    assert main(["echo", "--out", "x", "--verbose"]) == 7
    assert received == ["--out", "x"]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (DatasetError("room: no images;\n  check the path"), "room: no images; check the path"),
        (
            OSError(errno.ENOSPC, "No space left on device", "out/map.ply"),
            "out/map.ply: No space left on device; free some space or write elsewhere",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "/root/x"),
            "/root/x: Permission denied; choose a path that you may read and write",
        ),
        (OSError("strange"), "strange"),
        (
            MemoryError(),
            "not enough memory; close other programs or raise the limit (ulimit -v); runs need",
        ),
        (
            RuntimeError("[enforce fail] DefaultCPUAllocator: can't allocate memory: ..."),
            "not enough memory; close other programs or raise the limit (ulimit -v); runs need",
        ),
        (
            ModuleNotFoundError("No module named 'gtsam'", name="gtsam"),
            "the package 'gtsam' is missing; see: semsplat doctor",
        ),
        (
            UnicodeEncodeError("utf-8", "gr\udcf6", 2, 3, "surrogates not allowed"),
            "a library needs names in UTF-8, not gr\\udcf6; set the locale: export LC_ALL=C.UTF-8",
        ),
    ],
)
def test_what_a_user_can_mend_is_one_line(failing_job, capsys, error, line):
    failing_job(error)
    assert main(["fail"]) == 2
    printed = capsys.readouterr()
    assert printed.err.startswith(f"semsplat: error: {line}")
    assert printed.err.count("\n") == 1
    assert printed.out == ""


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_characters_that_an_output_lacks_are_escapes(monkeypatch, encoding):
    output = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, encoding))
    module = types.ModuleType("toolkit.tools.cli.say")
    module.main = lambda argv: print("Fußboden", "ソファ", "gr\udcf6") or 0
    monkeypatch.setitem(sys.modules, "toolkit.tools.cli.say", module)
    monkeypatch.setitem(command.JOBS, "say", ("say", "prints names"))
    assert main(["say"]) == 0
    printed = output.getvalue().decode(encoding)
    assert "Fußboden" in printed or (encoding == "ascii" and "Fu\\xdfboden" in printed)
    assert "ソファ" in printed or (encoding != "utf-8" and "\\u30bd\\u30d5\\u30a1" in printed)
    assert "gr\\udcf6" in printed


def test_an_interrupt_is_status_130(failing_job, capsys):
    failing_job(KeyboardInterrupt())
    assert main(["fail"]) == 130
    assert capsys.readouterr().err == "semsplat: interrupted\n"


@pytest.mark.parametrize(
    "fault",
    [
        ValueError("a fault of ours"),
        RuntimeError("a fault of ours"),
        ModuleNotFoundError("No module named 'toolkit.nonsense'", name="toolkit.nonsense"),
    ],
)
def test_our_own_faults_keep_their_traceback(failing_job, fault):
    failing_job(fault)
    with pytest.raises(type(fault)):
        main(["fail"])


def test_an_unknown_job_lists_the_jobs(capsys):
    assert main(["dance"]) == 2
    printed = capsys.readouterr().err
    assert "'dance'" in printed
    assert all(job in printed for job in JOBS)


def test_help_and_version(capsys):
    assert main(["--help"]) == 0
    described = capsys.readouterr().out
    assert all(f"\n  {job} " in described for job in JOBS)
    assert main([]) == 2
    assert capsys.readouterr().out == described
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"semsplat {toolkit.__version__}\n"


def test_a_reader_that_leaves_early_causes_no_complaint(checkout):
    program = (
        "import sys, types; from toolkit.tools.cli import main\n"
        "module = types.ModuleType('toolkit.tools.cli.talk')\n"
        "module.main = lambda argv: print('words') or 0\n"
        "sys.modules['toolkit.tools.cli.talk'] = module\n"
        "main.JOBS['talk'] = ('talk', 'talks')\n"
        "sys.stdin.read()\n"
        "sys.exit(main.main(['talk']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=checkout,
        env={name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    process.stdout.close()
    process.stdin.close()
    complaint = process.stderr.read()
    process.stderr.close()
    assert process.wait(timeout=60) == 1
    assert complaint == b""
