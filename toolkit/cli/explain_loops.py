"""`semsplat explain-loops`: a picture of every suspected loop, and what became of it."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import ExplainLoopsOptions
from toolkit.datasets.base import RecordedDataset
from toolkit.errors import FormatError, RunFolderError
from toolkit.frame import Frame
from toolkit.geometry import se3
from toolkit.geometry.frustum import Frustum, contained_fraction, far_depth_m, observed_points
from toolkit.io.images import write_rgb
from toolkit.io.pictures import (
    LegendEntry,
    Panel,
    Picture,
    colour_picture,
    legend_below,
    strip,
)
from toolkit.loops.log import read_loop_log
from toolkit.runs.finished import FinishedRun, load_run

_log = logging.getLogger(__name__)

_TAKEN, _REFUSED, _PLAIN = (30, 140, 60), (190, 40, 40), (120, 120, 120)
_POINTS = 1000
# Pictures are enlarged to this many pixels, or the lines below them could not be read.
_LEAST_WIDTH = 480

Record = dict[str, Any]

# Values of the records that are explained, by kind.
_NEEDED = {
    "candidate": (
        *("query", "match", "query_submap", "match_submap"),
        *("distance", "cosine", "landmark_distance", "accepted", "reason"),
    ),
    "between": ("first", "second", "reason"),
    "retracted": ("first", "second", "reason"),
    "found": ("first", "second"),
}


def main(argv: Sequence[str]) -> int:
    """Explain the loops of a run.

    Raises:
        ToolkitError: there is no finished run, its log or its data set cannot be read.
    """
    options = parse_arguments(ExplainLoopsOptions, list(argv), "explain-loops")
    run = load_run(options.run)
    records = read_loop_log(run.folder.loops)
    _check(records, run.folder.loops)
    suspected = [
        (place, record)
        for place, record in enumerate(records)
        if record["kind"] == "candidate" and (record["accepted"] or options.refused)
        # The frames of a saved map are not in this run's data set.
        if record["match"] >= 0
    ]
    for line in summary(records):
        print(line)
    if not suspected:
        return 0
    out = options.out or run.folder.path / "loops"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"cannot make {out}: {error.strerror}; choose another --out"
        ) from error
    dataset = run.open_dataset(options.dataset_path)
    for place, candidate in tqdm(suspected, unit="loop"):
        picture = explained(run, dataset, candidate, verdicts_on(candidate, records[place + 1 :]))
        name = f"frame{candidate['query']:06d}_frame{candidate['match']:06d}.png"
        write_rgb(out / name, picture.astype(np.float32) / 255.0)
    _log.info("%d pictures in %s", len(suspected), out)
    return 0


def _check(records: Sequence[Record], path: Path) -> None:
    """Check that the records have the values that are shown.

    Raises:
        FormatError: a value is missing.
    """
    for number, record in enumerate(records, start=1):
        needed = _NEEDED.get(record.get("kind", ""), ("kind",))
        missing = [key for key in needed if key not in record]
        if missing:
            raise FormatError(f"{path}:{number} lacks {', '.join(missing)}; remove the line")


def summary(records: Sequence[Record]) -> list[str]:
    """The story of a run's loops, a line each."""
    candidates = [r for r in records if r["kind"] == "candidate"]
    accepted = [r for r in candidates if r["accepted"]]
    lines = [f"{len(candidates)} keyframes considered, {len(accepted)} of them suspected"]
    for record in records:
        if record["kind"] in ("within", "consistency") and "query" in record:
            pair = f"frames {record['query']} and {record['match']}"
            if not record["accepted"]:
                lines.append(f"{pair}: refused, {record['reason']}")
        elif record["kind"] in ("between", "consistency", "retracted"):
            pair = f"submaps {record['first']} and {record['second']}"
            lines.append(f"{pair}: {record['reason'] or 'registered'}{_moved(record)}")
        elif record["kind"] == "found":
            lines.append(
                f"submap {record['second']} begins where submap {record['first']} was found"
            )
        elif record["kind"].startswith("correction") and "largest_m" in record:
            what = "anchors" if record["kind"].endswith("between") else "keyframes"
            largest = f"{100 * record['largest_m']:.1f} cm"
            lines.append(f"{record['loops']} loops: {what} move by up to {largest}")
    return lines


def verdicts_on(candidate: Record, later: Sequence[Record]) -> list[Record]:
    """What later lines of the log say of a candidate: of its frames, or of its submaps."""
    submaps = {candidate["query_submap"], candidate["match_submap"]}
    if len(submaps) == 1:
        frames = (candidate["query"], candidate["match"])
        found = [r for r in later if (r.get("query"), r.get("match")) == frames]
        return [r for r in found if r["kind"] in ("within", "consistency")]
    about = [r for r in later if {r.get("first"), r.get("second")} == submaps]
    pair = (candidate["query"], candidate["match"])
    return [
        r
        for r in about
        if r["kind"] in ("between", "consistency", "retracted")
        or (r["kind"] == "verified" and (r["query"], r["match"]) == pair)
    ]


def explained(
    run: FinishedRun, dataset: RecordedDataset, candidate: Record, verdicts: Sequence[Record]
) -> np.ndarray:
    """The two views of a candidate side by side, and the numbers below."""
    frames = [dataset[candidate[name]] for name in ("query", "match")]
    panels = [
        Panel(f"frame {frame.index}, submap {candidate[submap]}", _enlarged(frame))
        for frame, submap in zip(frames, ("query_submap", "match_submap"), strict=True)
    ]
    landmarks = candidate["landmark_distance"]
    told = "tell nothing" if landmarks is None else f"differ by {landmarks:.3f}"
    entries = [
        LegendEntry(
            f"descriptors differ by {candidate['distance']:.3f}, cosine {candidate['cosine']:.3f}; "
            f"landmarks {told}",
            _PLAIN,
        ),
        LegendEntry(_overlap(run, frames), _PLAIN),
        *_lines("search", candidate),
        *(line for record in verdicts for line in _lines(record["kind"], record)),
    ]
    return legend_below(strip(panels), entries, len(entries))


def _enlarged(frame: Frame) -> Picture:
    """A frame's picture, each pixel as many wide and high as make it wide enough."""
    picture = colour_picture(frame.rgb)
    factor = math.ceil(_LEAST_WIDTH / picture.shape[1])
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _lines(stage: str, record: Record) -> list[LegendEntry]:
    """A verdict, and below it the figures that it rests on."""
    colour = _TAKEN if record["accepted"] else _REFUSED
    lines = [LegendEntry(f"{stage}: {record['reason'] or 'accepted'}", colour)]
    figures = ""
    if record.get("overlap") is not None:
        figures = f"overlap {100 * record['overlap']:.0f} %, surfaces agree on "
        figures += f"{100 * record['inliers']:.0f} % of it{_moved(record)}"
    elif record.get("shared") is not None:
        figures = f"{100 * record['shared']:.0f} % of the first view is in the second, "
        figures += f"cameras {record['apart_m']:.2f} m apart"
    return [*lines, LegendEntry(figures, _PLAIN)] if figures else lines


def _moved(record: Record) -> str:
    if record.get("moved_m") is None:
        return ""
    turned = np.degrees(record["turned_rad"])
    return f", {100 * record['moved_m']:.1f} cm and {turned:.2f} degrees off the odometry"


def _overlap(run: FinishedRun, frames: Sequence[Frame]) -> str:
    """How much of the first view the second one sees, from the run's final poses."""
    poses = {f.index: f.T_map_camera for f in run.tracked}
    if any(frame.index not in poses for frame in frames):
        return "no overlap known: a frame has no pose"
    query, match = frames
    points = observed_points(query.camera, query.depth_m, _POINTS)
    points = se3.transform_points(poses[query.index], points[np.isfinite(points).all(axis=1)])
    volume = Frustum(match.camera, poses[match.index], far_m=far_depth_m(match.depth_m))
    share = contained_fraction(points, [volume])
    apart = np.linalg.norm(poses[query.index][:3, 3] - poses[match.index][:3, 3])
    return f"{100 * share:.0f} % of the first view is in the second, cameras {apart:.2f} m apart"
