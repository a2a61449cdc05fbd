"""`semsplat register`: register the maps of two runs and merge them."""

from __future__ import annotations

import json
import logging
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from toolkit.base.errors import ToolkitError
from toolkit.base.geometry import se3
from toolkit.io.atomic import write_bytes, write_text
from toolkit.io.splats import write_splat_ply
from toolkit.io.trajectories import write_tum
from toolkit.runs.folder import RunFolder
from toolkit.runs.maps.finished import FinishedRun, load_run
from toolkit.runs.maps.instance_files import write_instances
from toolkit.runs.maps.merged_map import MergedMap, label_conflict, merge
from toolkit.runs.maps.registering import register_runs
from toolkit.runs.new_folder import NewFolder
from toolkit.slam.loops.two_maps import (
    MapRegistration,
    SelectedRegistration,
    select_registration,
)
from toolkit.tools.cli.programs import RegisterOptions

_log = logging.getLogger(__name__)


def main(options: RegisterOptions) -> int:
    """Register two runs and merge their maps.

    Raises:
        ToolkitError: a run or its submaps cannot be read, their descriptors cannot be
            compared, no registration can be verified, or the result cannot be written.
    """
    a, b = load_run(options.run_a), load_run(options.run_b)
    submaps_a, submaps_b = a.submaps, b.submaps
    registrations = register_runs(a, b, options.pairs, options.registration)
    selection = select_registration(registrations)
    if selection is None:
        raise ToolkitError(_failure(options, registrations))
    T_a_b = selection.best.T_first_second
    merged = merge(a, b, submaps_a, submaps_b, T_a_b)
    report = _report(options, registrations, selection) | {
        "gaussians": len(merged.gaussians),
        "gaussians_a": sum(len(s.gaussians) for s in submaps_a.values()),
        "gaussians_b": sum(len(s.gaussians) for s in submaps_b.values()),
        "labels": merged.labels is not None,
        "no_labels_because": label_conflict(a, b),
    }
    for line in _lines(report, selection):
        print(line)
    with NewFolder(str(options.out), "register", options).written():
        _write(options.out, merged, (a, b), T_a_b, report)
    print(f"wrote {len(merged.gaussians)} Gaussians to {options.out / 'map.ply'}")
    return 0


def _write(
    out: Path,
    merged: MergedMap,
    runs: tuple[FinishedRun, FinishedRun],
    T_a_b: NDArray[np.float64],
    report: dict[str, Any],
) -> None:
    """Write the merged map, both trajectories in its frame, and the report."""
    columns = merged.columns()
    write_splat_ply(out / "map.ply", merged.gaussians, columns, runs[0].map_comments)
    if merged.instances is not None:
        write_instances(merged.instances, RunFolder(out), merged.taxonomy)
    if merged.taxonomy is not None:
        merged.taxonomy.save(out / "taxonomy.yaml")
    # Copied as bytes: reading and writing may change the last digit of a pose.
    write_bytes(out / "trajectory_a.txt", runs[0].folder.trajectory.read_bytes())
    write_tum(out / "trajectory_b.txt", runs[1].folder.read_trajectory().transformed(T_a_b))
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_text(out / "register.json", text)


def _failure(options: RegisterOptions, registrations: list[MapRegistration]) -> str:
    """Return the error message if no registration was verified."""
    first = registrations[0]
    return (
        f"no registration of {options.run_b} with {options.run_a} can be verified; "
        f"{len(registrations)} pair(s) of submaps were registered, and the most similar one "
        f"(submaps {first.pair.first} and {first.pair.second}) was rejected: {first.reason}; "
        "increase --pairs, or record an area in both runs"
    )


def _report(
    options: RegisterOptions, registrations: list[MapRegistration], selection: SelectedRegistration
) -> dict[str, Any]:
    """Return the content of register.json: the selected and all other registrations."""
    best = selection.best
    return {
        "run_a": str(options.run_a),
        "run_b": str(options.run_b),
        "T_a_b": best.T_first_second.tolist(),
        "submap_a": best.pair.first,
        "submap_b": best.pair.second,
        **best.result.quality_values(),
        "verified": selection.verified,
        "agreeing": selection.agreeing,
        "tried": [r.result.quality_values() | _verdict(r) for r in registrations],
    }


def _verdict(registration: MapRegistration) -> dict[str, Any]:
    pair = registration.pair
    return {
        "submap_a": pair.first,
        "submap_b": pair.second,
        "descriptor_distance": pair.distance,
        "accepted": not registration.reason,
        "reason": registration.reason,
    }


def _lines(report: dict[str, Any], selection: SelectedRegistration) -> list[str]:
    """Return the printed summary."""
    T: NDArray[np.float64] = selection.best.T_first_second
    rotation_deg = math.degrees(float(se3.rotation_angle_rad(T[:3, :3])))
    classes = report["class_agreement"]
    same_class = "" if classes is None else f", {100 * classes:.0f} % with the same class"
    lines = [
        f"{len(report['tried'])} pair(s) of submaps registered, {selection.verified} verified, "
        f"{selection.agreeing} consistent with the selected one",
        f"submap {report['submap_b']} of B registered with submap {report['submap_a']} of A: "
        f"overlap {100 * report['overlap']:.0f} %, {100 * report['inliers']:.0f} % inliers"
        f"{same_class}; residuals: intensity {report['intensity']:.3f}, depth "
        f"{1000 * report['depth_m']:.1f} mm at 1 m",
        f"transformation from B to A: {np.linalg.norm(T[:3, 3]):.3f} m, {rotation_deg:.1f} degrees",
    ]
    if selection.agreeing < selection.verified:
        lines.append(
            "warning: verified pairs contradict each other, which occurs if two places look alike; "
            "see register.json"
        )
    if report["no_labels_because"]:
        lines.append(f"the merged map has no labels: {report['no_labels_because']}")
    return lines
