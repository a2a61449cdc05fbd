"""Large and irregular motion: lost, doubtful and silently wrong frames, beside other methods.

SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.motion --subset
SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.motion --only 'RedKitchen, stride 8'
SEMSPLAT_DATA=DATA python -m benchmarks.accuracy.motion --only RedKitchen --methods semsplat

ORB-SLAM3 is measured if it is installed: pip install --no-deps orbslam3-python
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, get_args

import tyro

from benchmarks.accuracy.motion_cases import (
    CASES,
    INTERRUPTIONS,
    STRIDES,
    CaseDataset,
    MixedDataset,
    cases_of,
    mirrored_later,
    one_after_another,
    unrelated_photos,
    with_blank_wall,
)
from benchmarks.accuracy.motion_methods import (
    CaseSource,
    RivalName,
    RivalProcess,
    recorded,
    semsplat,
)
from benchmarks.accuracy.silent_errors import (
    TruthError,
    in_wrong_part,
    motion_metrics,
    silently_wrong,
)
from benchmarks.shared.runner import Report, ReportOptions
from benchmarks.shared.tables import Metrics, Rows, Table, Target, table_of, target_table

MethodName = Literal["semsplat", "open3d", "opencv", "orbslam3"]
Job = list[str]

COLUMNS = (
    *("ate_cm", "frames", "frames_lost", "frames_doubtful", "parts", "silently_wrong"),
    *("keyframes", "steps_per_keyframe"),
)
BAD_COLUMNS = (
    *("frames", "frames_lost", "frames_doubtful", "parts", "silently_wrong", "in_wrong_part"),
)
RIVAL_COLUMNS = ("ate_cm", "frames_lost", "silently_wrong")
LABELS: dict[RivalName, str] = {"open3d": "Open3D", "opencv": "OpenCV", "orbslam3": "ORB-SLAM3"}
# They depend on times only, which the rivals do not use.
_WITHOUT_RIVALS = ("half speed", "double speed")


_EXACT = TruthError()


@dataclass(frozen=True)
class Sequence:
    """A sequence of the benchmark.

    Attributes:
        name: a key of RECORDINGS or of ROOMS.
        frames: their number.
        error: of the true poses.
        image_size: width and height in pixels; the usual ones of the sequence if None.
        cases: keys of CASES; those that fit its length if empty.
    """

    name: str
    frames: int
    error: TruthError = _EXACT
    image_size: tuple[int, int] | None = None
    cases: tuple[str, ...] = ()

    @property
    def all_cases(self) -> list[str]:
        """The cases that are measured."""
        return [name for name in cases_of(self.frames) if not self.cases or name in self.cases]


KITCHEN = "RedKitchen"
_KITCHEN_ERROR = TruthError(0.015, 0.5)
# The other cases are those of the same recording at 15 frames per second.
_MOTION = tuple(name for name in CASES if name.startswith(("stride", "jump")) or "drop" in name)
_SMALL_STRIDES = ("stride 1", "stride 2", "stride 4")
SEQUENCES = {
    KITCHEN: Sequence("redkitchen", 200, _KITCHEN_ERROR),
    "RedKitchen at 30 fps": Sequence("redkitchen_30fps", 600, _KITCHEN_ERROR, cases=_MOTION),
    "fr1/rpy": Sequence("fr1_rpy", 120, TruthError(0.005, 0.3)),
    "office0": Sequence("office0", 51),
    "HoloLens walk": Sequence("hololens", 260, TruthError(0.02, 0.5), (270, 180)),
    "room": Sequence("room", 300),
    "room, weak texture": Sequence("room-weak", 300),
    "room, narrow view": Sequence("room-narrow", 300),
    "room, sensor noise": Sequence("room-noise", 300),
    "corridor": Sequence("corridor", 600, cases=_SMALL_STRIDES),
    "corridor, turns": Sequence("corridor-turns", 600, cases=_SMALL_STRIDES),
    "corridor, stop": Sequence("corridor-stop", 600, cases=_SMALL_STRIDES),
    "corridor (TartanAir)": Sequence("tartanair-corridor", 70, cases=_SMALL_STRIDES),
    "wallpaper": Sequence("wallpaper", 300, cases=_SMALL_STRIDES),
    "stripes": Sequence("stripes", 300, cases=_SMALL_STRIDES),
}

_BAD_SIZE = (320, 240)
# Frames of the corridor before the hall; half of the way is between two doors.
_WAY_THERE = 240
BAD_INPUTS: dict[str, Callable[[], MixedDataset | CaseDataset]] = {
    "unrelated photos": lambda: unrelated_photos(
        [recorded(n, _BAD_SIZE) for n in ("redkitchen", "fr1_rpy", "office0", "hololens", "room")]
    ),
    "RedKitchen, blank wall": lambda: with_blank_wall(recorded("redkitchen", _BAD_SIZE)),
    "room, blank wall": lambda: with_blank_wall(recorded("room", _BAD_SIZE)),
    "RedKitchen, then fr1/rpy": lambda: one_after_another(
        recorded("redkitchen", _BAD_SIZE), recorded("fr1_rpy", _BAD_SIZE)
    ),
    "room, then another room": lambda: one_after_another(
        recorded("room", _BAD_SIZE), recorded("room", _BAD_SIZE, seed=1)
    ),
    "RedKitchen, mirrored": lambda: mirrored_later(recorded("redkitchen", _BAD_SIZE)),
    **{
        f"corridor, {case}": CaseSource("corridor", None, case, frames=_WAY_THERE).open
        for case in INTERRUPTIONS
    },
}
# A few minutes; without rivals.
SUBSET = (
    *("RedKitchen, stride 1", "RedKitchen, stride 8", "RedKitchen, stride 16"),
    *("RedKitchen, jump of 100", "RedKitchen, covered", "fr1/rpy, stride 2"),
    *("fr1/rpy, bursts dropped", "office0, stride 2", "office0, stride 16"),
    *("HoloLens walk, stride 4", "room, stride 8", "room, weak texture, stride 4"),
    *("room, narrow view, stride 4", "room, sensor noise, 30 % dropped", "unrelated photos"),
    "RedKitchen, then fr1/rpy",
)

# The camera's poses do not depend on the last refinement of the map.
SETTINGS = {"mapping": {"final_iterations": 0}}
DESCRIPTION = """\
Every sequence with frames left out, covered, blurred or at other times. `semsplat` has its default
settings, but the map is not refined at the end (`mapping.final_iterations` 0), on which poses do
not depend. Images have the sizes of sequences.md.

Cases. Stride N: every N-th frame. 30 % dropped: at random. Bursts dropped: 15 of every 60 frames.
Jump of N: N frames are missing in the middle. Covered: 10 frames in the middle are black and
without depth. Blur: 10 of every 30 frames, Gaussian, sigma 2 px; depth is as recorded. Repeated:
every frame twice, the second time halfway to the next one. Half and double speed: all frames, with
the times between them, and those of the readout of their rows, doubled or halved.

Some views of the last sequences do not determine the motion. Corridor (`semsplat make-room --layout
corridor --glossy --sensor-noise`, 6 cm per frame): white panels with joints of 5 mm, identical
doors every 3.75 m and a stretch without joints, to a hall and back; with turns to the sides, and
with a stop of 20 frames. Corridor (TartanAir): one of a hospital, up to 14 cm per frame.
Wallpaper and stripes (`--layout wall`, 3 cm per frame): along a wall whose pattern repeats every
12.5 cm.

`silently_wrong`: frames with a pose, neither lost nor doubtful, whose motion since the previous
such frame of the same part is off by more than 5 cm or 2 degrees, plus the error of the truth:
1.5 cm and 0.5 degrees on RedKitchen, 0.5 cm and 0.3 degrees on fr1/rpy, 2 cm and 0.5 degrees on the
HoloLens walk, none elsewhere. `ate_cm`: of the final poses of the largest part, after SE(3)
alignment; none for fewer than three poses. `steps_per_keyframe`: of the map's optimisation.

Bad inputs have 320x240 pixels. Unrelated photos: 8 frames of each of five scenes in turn. Blank
wall: 100 frames of a uniform wall in the middle. Then: the first halves of two recordings.
Mirrored: the second half of the recording, left-right, colour and depth; it is another scene.
Interruptions of the way along the corridor: the frame in the middle in place of the ten after it
(frozen), and a second of black frames without depth (black) or without frames (pause).
`in_wrong_part`: frames, neither lost nor doubtful, in a part of which most show another scene.

Rivals: Open3D's hybrid odometry, started from constant velocity, with 30, 20 and 10 iterations;
OpenCV's `Odometry` of colour and depth with its defaults, which reports a failure if the motion
exceeds 15 cm or 15 degrees; both ignore depth beyond 4 m. ORB-SLAM3 (orbslam3-python with depth and
a vocabulary of 40 images of each of eleven sequences) is given the strides only, slowly enough for
its mapping thread. A rival's frames are lost where it reports a failure; later ones are another
part. Half and double speed make no difference to them."""


@dataclass(frozen=True, kw_only=True)
class Options(ReportOptions):
    """Measure large and irregular motion.

    `--only` takes names of sequences, or of rows, as 'RedKitchen, stride 8', with their rivals.
    """

    methods: tuple[MethodName, ...] = get_args(MethodName)
    """Methods to measure."""
    subset: bool = False
    """Measure some rows without rivals, in a few minutes."""


def main() -> None:
    """Measure one row for each sequence, case and method, and for each bad input."""
    options = tyro.cli(Options)
    jobs = all_jobs()
    report = Report("motion", "Motion", DESCRIPTION, replace(options, only=chosen(options, jobs)))
    rivals = RivalProcess()
    try:
        rows = report.measured(jobs, lambda job, seed: measure(job, seed, rivals))
    finally:
        rivals.close()
    own = {name: runs for name, runs in rows.items() if jobs[name][0] == "semsplat"}
    bad = {name: runs for name, runs in rows.items() if jobs[name][0] == "bad input"}
    report.write(
        table_of(COLUMNS, own, "sequence"),
        table_of(BAD_COLUMNS, bad, "input", "Bad inputs"),
        rivals_table(rows),
        target_table(targets(rows)),
    )


def all_jobs() -> dict[str, Job]:
    """Method, sequence and case of every row, or "bad input" and its name."""
    jobs: dict[str, Job] = {}
    for sequence, values in SEQUENCES.items():
        for case in values.all_cases:
            jobs[f"{sequence}, {case}"] = ["semsplat", sequence, case]
    for name in BAD_INPUTS:
        jobs[name] = ["bad input", name]
    for sequence, values in SEQUENCES.items():
        for case in values.all_cases:
            for rival in rivals_of(case):
                jobs[rival_row(sequence, case, rival)] = [rival, sequence, case]
    return jobs


def rivals_of(case: str) -> list[RivalName]:
    """The rivals that a case is measured with."""
    if case in _WITHOUT_RIVALS:
        return []
    strided = case.startswith("stride")
    return [rival for rival in LABELS if rival != "orbslam3" or strided]


def rival_row(sequence: str, case: str, rival: RivalName) -> str:
    """The name of a rival's row."""
    return f"{sequence}, {case}: {LABELS[rival]}"


def chosen(options: Options, jobs: Mapping[str, Job]) -> tuple[str, ...]:
    """The names of the rows to measure; none for all of them.

    Raises:
        SystemExit: a name is unknown.
    """
    if options.subset:
        return SUBSET
    known = {name for row, job in jobs.items() for name in (row, job[1])}
    unknown = set(options.only) - known
    if unknown:
        raise SystemExit(f"--only: no '{min(unknown)}'; sequences: {', '.join(SEQUENCES)}")
    rows = tuple(
        row
        for row, job in jobs.items()
        if ("semsplat" if job[0] == "bad input" else job[0]) in options.methods
        and (not options.only or {row, row.partition(": ")[0], job[1]} & set(options.only))
    )
    return () if len(rows) == len(jobs) else rows


def measure(job: Job, seed: int, rivals: RivalProcess) -> Metrics:
    """Run one method on the frames of one case."""
    if job[0] == "bad input":
        return _measure_bad_input(job[1], seed)
    method, name, case = job
    sequence = SEQUENCES[name]
    source = CaseSource(sequence.name, sequence.image_size, case, seed)
    dataset = source.open(estimate_shutter=method == "semsplat")
    if method == "semsplat":
        return motion_metrics(semsplat(dataset, seed, SETTINGS), dataset.truth, sequence.error)
    rival = next(known for known in LABELS if known == method)
    estimate = rivals.estimate(rival, source)
    if isinstance(estimate, str):
        return {"outcome": estimate}
    return motion_metrics(estimate, dataset.truth, sequence.error)


def _measure_bad_input(name: str, seed: int) -> Metrics:
    dataset = BAD_INPUTS[name]()
    estimate = semsplat(dataset, seed, SETTINGS)
    wrong = silently_wrong(estimate, dataset.truth, scenes=dataset.scenes)
    return {
        **motion_metrics(estimate, {}),
        "silently_wrong": len(wrong),
        "in_wrong_part": len(in_wrong_part(estimate, dataset.scenes)),
    }


def rivals_table(rows: Rows) -> Table:
    """The figures that all methods have, side by side; why a method has none instead of its ATE."""
    beside: dict[str, list[Metrics]] = {}
    for sequence, values in SEQUENCES.items():
        for case in values.all_cases:
            if f"{sequence}, {case}" not in rows or not rivals_of(case):
                continue
            runs = {"semsplat": rows[f"{sequence}, {case}"][0]}
            for rival, label in LABELS.items():
                found = rows.get(rival_row(sequence, case, rival), [{}])[0]
                runs[label] = {**found, "ate_cm": found.get("outcome", found.get("ate_cm"))}
            beside[f"{sequence}, {case}"] = [
                {
                    f"{method}: {column}": run.get(column)
                    for column in RIVAL_COLUMNS
                    for method, run in runs.items()
                }
            ]
    methods = ("semsplat", *LABELS.values())
    columns = [f"{method}: {column}" for column in RIVAL_COLUMNS for method in methods]
    return table_of(columns, beside, "sequence", "Beside other methods")


def targets(rows: Rows) -> list[Target]:
    """What semsplat should reach on the measured rows."""
    small = [f"stride {step}" for step in STRIDES if step <= 8]
    large = [f"stride {step}" for step in STRIDES if step > 8]
    gaps = [case for case in _MOTION if not case.startswith("stride")]
    wrong, frames = _total(rows, large, "silently_wrong"), _total(rows, large, "frames")
    percent = None if wrong is None or not frames else 100.0 * wrong / frames
    found = [
        Target(
            "silently wrong at strides 1 to 8", _total(rows, small, "silently_wrong"), at_most=0
        ),
        Target(
            "silently wrong under drops, jumps and covers",
            _total(rows, [*gaps, "covered"], "silently_wrong"),
            at_most=0,
        ),
        Target("silently wrong at strides 16 and 24, in % of all frames", percent, at_most=1),
    ]
    for step in STRIDES:
        label = f"stride {step}, sequences where a rival that keeps tracking has a lower ATE"
        found.append(Target(label, _behind_rivals(rows, f"stride {step}"), at_most=0))
    for column in ("silently_wrong", "in_wrong_part"):
        values = [rows[name][0][column] for name in BAD_INPUTS if name in rows]
        label = f"bad inputs, {column.replace('_', ' ')}"
        found.append(Target(label, sum(values) if values else None, at_most=0))
    return found


def _total(rows: Rows, cases: Iterable[str], column: str) -> float | None:
    """Sum over semsplat's measured rows of some cases; None if there are none."""
    names = [f"{sequence}, {case}" for sequence in SEQUENCES for case in cases]
    values = [float(rows[name][0][column]) for name in names if name in rows]
    return sum(values) if values else None


def _behind_rivals(rows: Rows, case: str) -> float | None:
    """Number of sequences on which a rival loses no frame and has a lower ATE."""
    behind: list[bool] = []
    for sequence in SEQUENCES:
        own = rows.get(f"{sequence}, {case}")
        runs = [rows.get(rival_row(sequence, case, rival), [{}])[0] for rival in LABELS]
        rivals = [run["ate_cm"] for run in runs if run.get("frames_lost") == 0]
        best = min((ate for ate in rivals if ate is not None), default=None)
        if own is not None and any(runs):
            ate = own[0]["ate_cm"]
            behind.append(best is not None and (ate is None or ate > best))
    return float(sum(behind)) if behind else None


if __name__ == "__main__":
    main()
