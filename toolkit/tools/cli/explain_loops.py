"""`semsplat explain-loops`: draw every loop candidate of a run and its result."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from toolkit.base.errors import FormatError, RunFolderError
from toolkit.base.frame import Frame
from toolkit.base.geometry import se3
from toolkit.base.geometry.frustum import Frustum, contained_fraction, far_depth_m, observed_points
from toolkit.datasets.base import RecordedDataset
from toolkit.io.images import write_rgb
from toolkit.io.visualisation import (
    LegendEntry,
    Panel,
    RgbImage,
    colour_image,
    legend_below,
    strip,
)
from toolkit.runs.evaluation.loop_gallery import results_of
from toolkit.runs.evaluation.loops import LoopTruthOptions
from toolkit.runs.evaluation.missed_loops import MissedLoop, missed_loops
from toolkit.runs.evaluation.run_loops import loop_views
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.slam.loops.log import read_loop_log
from toolkit.tools.cli.programs import ExplainLoopsOptions

_log = logging.getLogger(__name__)

# Text colours of accepted and rejected results, and of other values.
_ACCEPTED, _REJECTED, _NEUTRAL = (30, 140, 60), (190, 40, 40), (120, 120, 120)
# Number of observed points for computing overlap.
_POINTS = 1000
# Images are enlarged to at least this width in pixels, so that the text below is readable.
_MIN_WIDTH = 480

Record = dict[str, Any]

# Required keys of the displayed records, by kind.
_REQUIRED = {
    "candidate": (
        *("query", "match", "query_submap", "match_submap"),
        *("distance", "cosine", "landmark_distance", "accepted", "reason"),
    ),
    "between": ("first", "second", "reason"),
    "retracted": ("first", "second", "reason"),
    "found": ("first", "second"),
    "entered": ("first", "second"),
}


def main(options: ExplainLoopsOptions) -> int:
    """Draw the loop candidates of a run.

    Raises:
        ToolkitError: there is no finished run, or its loop log or its dataset cannot be read.
    """
    run = load_run(options.run)
    records = read_loop_log(run.folder.loops)
    _check(records, run.folder.loops)
    candidates = [
        (position, record)
        for position, record in enumerate(records)
        if record["kind"] == "candidate" and (record["accepted"] or options.refused)
        # Frames of a loaded map are not in the dataset of this run.
        if record["match"] >= 0
    ]
    for line in summary(records):
        print(line)
    dataset = run.open_dataset(options.dataset_path)
    missed = _missed(run, dataset, records) if options.missed else []
    for loop in missed:
        print(f"frame {loop.query}: missed the loop with frame {loop.match}; {loop.reason}")
    if not candidates and not missed:
        return 0
    out = options.out or run.folder.path / "loops"
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunFolderError(
            f"cannot create {out}: {error.strerror}; choose another --out"
        ) from error
    for position, candidate in tqdm(candidates, unit="loop", disable=None):
        results = results_of(candidate, records[position + 1 :])
        picture = candidate_picture(run, dataset, candidate, results)
        name = f"frame{candidate['query']:06d}_frame{candidate['match']:06d}.png"
        write_rgb(out / name, picture.astype(np.float32) / 255.0)
    for loop in missed:
        name = f"missed_frame{loop.query:06d}_frame{loop.match:06d}.png"
        write_rgb(out / name, missed_picture(dataset, loop).astype(np.float32) / 255.0)
    _log.info("Wrote %d images to %s.", len(candidates) + len(missed), out)
    return 0


def _missed(
    run: FinishedRun, dataset: RecordedDataset, records: Sequence[Record]
) -> list[MissedLoop]:
    """The missed loops; none without ground truth."""
    if dataset.ground_truth is None or not any(r["kind"] == "search" for r in records):
        return []
    candidates = run.settings.loops.candidates
    truth = LoopTruthOptions(
        min_gap_frames=candidates.min_gap_frames, min_gap_m=candidates.min_gap_m
    )
    return missed_loops(records, loop_views(dataset, records), truth)


def missed_picture(dataset: RecordedDataset, loop: MissedLoop) -> np.ndarray:
    """Draw the two views of a missed loop side by side, with the reason below."""
    frames = [dataset[index] for index in (loop.query, loop.match)]
    panels = [Panel(f"frame {frame.index}", _enlarged(frame)) for frame in frames]
    shared = f"true loop, {100 * loop.overlap:.0f} % of the views are shared"
    entries = [LegendEntry(shared, _NEUTRAL), LegendEntry(f"missed: {loop.reason}", _REJECTED)]
    return legend_below(strip(panels), entries, len(entries))


def _check(records: Sequence[Record], path: Path) -> None:
    """Check that the records have the keys that are displayed."""
    for number, record in enumerate(records, start=1):
        required = _REQUIRED.get(record.get("kind", ""), ("kind",))
        missing = [key for key in required if key not in record]
        if missing:
            raise FormatError(f"{path}:{number} has no {', '.join(missing)}; remove the line")


def summary(records: Sequence[Record]) -> list[str]:
    """Return a summary of a run's loop log as lines of text."""
    candidates = [r for r in records if r["kind"] == "candidate"]
    accepted = [r for r in candidates if r["accepted"]]
    lines = [f"{len(candidates)} loop candidates, {len(accepted)} of them accepted"]
    for record in records:
        if record["kind"] in ("within", "images", "consistency") and "query" in record:
            pair = f"frames {record['query']} and {record['match']}"
            if not record["accepted"]:
                lines.append(f"{pair}: rejected, {record['reason']}")
        elif record["kind"] in ("between", "consistency", "retracted"):
            pair = f"submaps {record['first']} and {record['second']}"
            lines.append(f"{pair}: {record['reason'] or 'registered'}{_correction(record)}")
        elif record["kind"] == "found":
            lines.append(
                f"submap {record['second']} started at a frame relocalised in submap "
                f"{record['first']}"
            )
        elif record["kind"] == "entered":
            pair = f"submaps {record['first']} and {record['second']}"
            lines.append(f"{pair}: connected where the camera changed from one to the other")
        elif record["kind"].startswith("correction") and "largest_m" in record:
            corrected = "anchors" if record["kind"].endswith("between") else "keyframes"
            largest = f"{100 * record['largest_m']:.1f} cm"
            lines.append(f"{record['loops']} loops: {corrected} corrected by up to {largest}")
    return lines


def candidate_picture(
    run: FinishedRun, dataset: RecordedDataset, candidate: Record, results: Sequence[Record]
) -> np.ndarray:
    """Draw the two views of a candidate side by side, with its values below."""
    frames = [dataset[candidate[name]] for name in ("query", "match")]
    panels = [
        Panel(f"frame {frame.index}, submap {candidate[submap]}", _enlarged(frame))
        for frame, submap in zip(frames, ("query_submap", "match_submap"), strict=True)
    ]
    landmarks = candidate["landmark_distance"]
    landmark_text = "not available" if landmarks is None else f"{landmarks:.3f}"
    entries = [
        LegendEntry(
            f"descriptor distance {candidate['distance']:.3f}, cosine {candidate['cosine']:.3f}; "
            f"landmark distance {landmark_text}",
            _NEUTRAL,
        ),
        LegendEntry(_overlap(run, frames), _NEUTRAL),
        *_entries("search", candidate),
        *(entry for record in results for entry in _entries(record["kind"], record)),
    ]
    return legend_below(strip(panels), entries, len(entries))


def _enlarged(frame: Frame) -> RgbImage:
    """Return the image of a frame, enlarged by an integer factor to the minimum width."""
    picture = colour_image(frame.rgb)
    factor = math.ceil(_MIN_WIDTH / picture.shape[1])
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _entries(stage: str, record: Record) -> list[LegendEntry]:
    """Return the result of a stage and, below it, the values on which it is based."""
    colour = _ACCEPTED if record["accepted"] else _REJECTED
    entries = [LegendEntry(f"{stage}: {record['reason'] or 'accepted'}", colour)]
    values = ""
    if record.get("overlap") is not None:
        values = f"overlap {100 * record['overlap']:.0f} %, "
        values += f"{100 * record['inliers']:.0f} % inliers{_correction(record)}"
    elif record.get("shared") is not None:
        values = f"{100 * record['shared']:.0f} % of the first view is in the second, "
        values += f"cameras {record['apart_m']:.2f} m apart"
    return [*entries, LegendEntry(values, _NEUTRAL)] if values else entries


def _correction(record: Record) -> str:
    if record.get("moved_m") is None:
        return ""
    rotation_deg = np.degrees(record["turned_rad"])
    return f", {100 * record['moved_m']:.1f} cm and {rotation_deg:.2f} degrees from odometry"


def _overlap(run: FinishedRun, frames: Sequence[Frame]) -> str:
    """Describe the overlap of two views at the final poses of the run."""
    poses = {f.index: f.T_map_camera for f in run.tracked}
    if any(frame.index not in poses for frame in frames):
        return "overlap unknown: a frame has no pose"
    query, match = frames
    points = observed_points(query.camera, query.depth_m, _POINTS)
    points = se3.transform_points(poses[query.index], points[np.isfinite(points).all(axis=1)])
    volume = Frustum(match.camera, poses[match.index], far_m=far_depth_m(match.depth_m))
    overlap = 100 * contained_fraction(points, [volume])
    distance_m = np.linalg.norm(poses[query.index][:3, 3] - poses[match.index][:3, 3])
    return f"{overlap:.0f} % of the first view is in the second, cameras {distance_m:.2f} m apart"
