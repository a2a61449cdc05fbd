"""Damaged and hostile files, given to the reader of every format.

    python -m benchmarks.inputs.hostile_files [--only 'settings and plans']

Files are made on the spot (`hostile_attempts`) from valid samples of each format
(`hostile_samples`), and read in processes with limits (`hostile_limits`).
"""

from __future__ import annotations

import contextlib
import importlib
import random
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.inputs.hostile_attempts import Attempt, crafted, mutated
from benchmarks.inputs.hostile_limits import MAX_BYTES, MAX_S, limited, message_fault
from benchmarks.inputs.hostile_samples import AREAS, SAMPLES, Sample
from benchmarks.shared.runner import Page
from benchmarks.shared.tables import Metrics, Rows, Table

# Attempts of all areas; formats with few crafted files have fewer.
CRAFTED, MUTATED = 1000, 800
DESCRIPTION = f"""\
Crafted files and random changes of valid small ones, read as users reach the reader of each format.
An attempt passes if the file is read, or refused in one line that names it, within {MAX_S:.0f} s
and {MAX_BYTES // 2**30} GB of memory. A key that is given twice must be refused. Recordings of
COLMAP and nerfstudio, and splats, are exports of a run."""


def measure(area: str, seed: int) -> Metrics:
    """Attempts and failures of an area."""
    _import()
    total = sum(sample.weight for sample in SAMPLES.values())
    found: list[Metrics] = []
    for name, sample in SAMPLES.items():
        if sample.area == area:
            counts = [round(count * sample.weight / total) for count in (CRAFTED, MUTATED)]
            found += outcomes(name, sample, counts, seed)
    return {
        "attempts": len(found),
        "failures": [outcome for outcome in found if outcome["fault"]],
        "longest_s": max(outcome["seconds"] for outcome in found),
        "largest_mb": max(outcome["memory_mb"] for outcome in found),
    }


def outcomes(name: str, sample: Sample, counts: Sequence[int], seed: int) -> Iterator[Metrics]:
    """Try files of a sample.

    Args:
        counts: numbers of crafted files and of random changes.

    Raises:
        RuntimeError: the valid sample is not read.
    """
    chance = random.Random(f"{name} {seed}")
    with tempfile.TemporaryDirectory(prefix="hostile-") as temporary:
        base, place = Path(temporary) / "valid", Path(temporary) / "damaged"
        base.mkdir()
        written = limited(lambda: sample.write(base))
        whole = limited(lambda: sample.read(base)) if not written.fault else written
        if whole.fault or whole.message:
            raise RuntimeError(f"{name}: the valid sample is not read: {whole}")
        special = [Attempt(title, "", change) for title, change in sample.special.items()]
        attempts = special + crafted(base, sample.files, chance)
        attempts = attempts[: max(counts[0], len(special))]
        attempts += mutated(base, sample.files, chance, counts[1])
        for attempt in attempts:
            shutil.copytree(base, place, symlinks=True)
            attempt.change(place / attempt.file)
            yield {"sample": name, "attempt": attempt.name, **_judged(sample, attempt, place)}
            shutil.rmtree(place)


def _judged(sample: Sample, attempt: Attempt, place: Path) -> Metrics:
    found = limited(lambda: sample.read(place))
    fault = found.fault
    if not fault and attempt.must_fail and not found.message:
        fault = "read without a word"
    if not fault and found.message:
        fault = message_fault(found.message, [Path(attempt.file).name, place.name])
    message = found.message.replace(str(place.parent), "")[:300]
    return vars(found) | {"fault": fault, "message": message}


def _import() -> None:
    """Import what readers need once, before processes are forked."""
    from toolkit.base.geometry.open3d_bridge import open3d

    open3d()
    for name in ("openai", "pxr.Usd", "rosbags.highlevel", "safetensors", "transformers"):
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def counted(rows: Rows) -> Table:
    """Attempts, passed and failed of each area and of all."""
    cells, sums = [], Counter[str]()
    for area, (run,) in rows.items():
        failed = len(run["failures"])
        counts = {"attempts": run["attempts"], "passed": run["attempts"] - failed, "failed": failed}
        sums.update(counts)
        ends = (f"{run['longest_s']:.1f}", f"{max(0, run['largest_mb']):.0f}")
        cells.append((area, *map(str, counts.values()), *ends))
    names = ("attempts", "passed", "failed")
    cells.append(("all", *(str(sums[name]) for name in names), "", ""))
    return Table(("area", *names, "longest, s", "most memory, MB"), tuple(cells))


def by_cause(rows: Rows) -> Table:
    """The failures by cause, with an example of each."""
    found: dict[tuple[str, str], list[Metrics]] = {}
    for area, (run,) in rows.items():
        for failure in run["failures"]:
            found.setdefault((failure["fault"], area), []).append(failure)
    ordered = sorted(found.items(), key=lambda each: (-len(each[1]), each[0]))
    cells = [
        (cause, area, str(len(some)), _cell(f"{some[0]['sample']}, {some[0]['attempt']}"))
        for (cause, area), some in ordered
    ]
    columns = ("cause", "area", "failures", "for instance")
    return Table(columns, tuple(cells), "Failures", "" if cells else "None.")


def _cell(text: str) -> str:
    return text.replace("|", "/").replace("\n", " ")[:100]


PAGE = Page(
    "hostile-files",
    "Damaged and hostile files",
    DESCRIPTION,
    {area: area for area in AREAS},
    measure,
    lambda rows: [counted(rows), by_cause(rows)],
)

if __name__ == "__main__":
    PAGE.main()
