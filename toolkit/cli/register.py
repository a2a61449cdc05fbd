"""`semsplat register`: where one run's map lies in another's, and both as one map."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.baselines.factory import build_registrar, needs_describer
from toolkit.cli.arguments import parse_arguments
from toolkit.cli.programs import RegisterOptions
from toolkit.errors import RunFolderError, SettingsError, ToolkitError
from toolkit.features.factory import build_describer
from toolkit.geometry import se3
from toolkit.io.atomic import cannot_write, write_bytes
from toolkit.io.splats import write_splat_ply
from toolkit.io.trajectories import write_tum
from toolkit.loops.two_maps import (
    MapRegistration,
    Selection,
    most_similar_submaps,
    register_submaps,
    select_registration,
)
from toolkit.registration.factory import build_view_renderer
from toolkit.runs.finished import FinishedRun, load_run
from toolkit.runs.merged_map import merge, not_one_tree, shared_reading
from toolkit.submaps.saved import SavedSubmaps

_log = logging.getLogger(__name__)


def main(argv: Sequence[str]) -> int:
    """Register two runs and merge their maps.

    Raises:
        ToolkitError: a run or its submaps cannot be read, their descriptors cannot be
            compared, no registration can be verified, or the result cannot be written.
    """
    options = parse_arguments(RegisterOptions, list(argv), "register")
    _check(options)
    a, b = load_run(options.run_a), load_run(options.run_b)
    submaps_a, submaps_b = a.submaps, b.submaps
    _check_descriptors(a, b, submaps_a, submaps_b)
    objection = not_one_tree(a, b)
    found = _registered(options, a, b, (submaps_a, submaps_b))
    choice = select_registration(found)
    if choice is None:
        raise ToolkitError(_nothing_holds(options, found))
    T_a_b = choice.best.T_first_second
    merged = merge(a, b, submaps_a, submaps_b, T_a_b)
    report = _report(options, found, choice) | {
        "gaussians": len(merged.gaussians),
        "gaussians_a": sum(len(s.gaussians) for s in submaps_a.values()),
        "gaussians_b": sum(len(s.gaussians) for s in submaps_b.values()),
        "labels": merged.labels is not None,
        "no_labels_because": objection,
    }
    for line in _lines(report, choice):
        print(line)
    _make(options.out)
    write_splat_ply(options.out / "map.ply", merged.gaussians, merged.columns())
    if merged.taxonomy is not None:
        merged.taxonomy.save(options.out / "taxonomy.yaml")
    # The very bytes: read and written again, a pose may differ in its last digit.
    write_bytes(options.out / "trajectory_a.txt", a.folder.trajectory.read_bytes())
    write_tum(options.out / "trajectory_b.txt", b.folder.read_trajectory().transformed(T_a_b))
    text = json.dumps(report, indent=1, allow_nan=False) + "\n"
    write_bytes(options.out / "register.json", text.encode())
    print(f"wrote {len(merged.gaussians)} Gaussians to {options.out / 'map.ply'}")
    return 0


def _check(options: RegisterOptions) -> None:
    """What can be told before a long job.

    Raises:
        RunFolderError: --out is in use.
    """
    out = options.out
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise RunFolderError(f"{out} is not an empty folder; choose another --out")


def _check_descriptors(
    a: FinishedRun, b: FinishedRun, submaps_a: SavedSubmaps, submaps_b: SavedSubmaps
) -> None:
    """Refuse runs whose keyframes were not described, or by different means.

    Raises:
        SettingsError: so it is; the settings are named.
    """
    lengths = []
    for run, submaps in ((a, submaps_a), (b, submaps_b)):
        length = max(submap.descriptors.shape[1] for submap in submaps.values())
        if not length:
            raise SettingsError(
                f"the keyframes of {run.folder.path} have no descriptors, by which places are "
                "recognised; run again with --loops.use"
            )
        lengths.append(length)
    before, after = a.settings.loops.features, b.settings.loops.features
    if lengths[0] != lengths[1] or before != after:
        raise SettingsError(
            f"{a.folder.path} has descriptors of {lengths[0]} numbers ({_named(before)}), "
            f"{b.folder.path} of {lengths[1]} ({_named(after)}): they cannot be compared; run one "
            "of them again with the other's --loops.features"
        )


def _named(features: Any) -> str:
    return f"loops.features.kind {features.kind}, source {features.source}"


def _registered(
    options: RegisterOptions,
    a: FinishedRun,
    b: FinishedRun,
    submaps: tuple[SavedSubmaps, SavedSubmaps],
) -> list[MapRegistration]:
    backend = a.settings.backend
    renderer = build_view_renderer(options.registration, shared_reading(a, b), backend)
    describer = None
    if needs_describer(options.registration):
        describer = build_describer(a.settings.loops.features)
    registrar = build_registrar(options.registration, a.settings.seed, renderer, describer)
    pairs = most_similar_submaps(*submaps, options.pairs)
    return [
        register_submaps(pair, *submaps, registrar, options.verification)
        for pair in tqdm(pairs, unit="pair of submaps")
    ]


def _nothing_holds(options: RegisterOptions, found: list[MapRegistration]) -> str:
    nearest = found[0]
    return (
        f"no place of {options.run_b} can be verified in {options.run_a}, of {len(found)} pair(s) "
        f"of submaps tried; the most alike, {nearest.pair.first} and {nearest.pair.second}: "
        f"{nearest.reason}; try more --pairs, or record a place that both show"
    )


def _report(
    options: RegisterOptions, found: list[MapRegistration], choice: Selection
) -> dict[str, Any]:
    """What register.json holds: the choice, and every pair that was tried."""
    best = choice.best
    return {
        "run_a": str(options.run_a),
        "run_b": str(options.run_b),
        "T_a_b": best.T_first_second.tolist(),
        "submap_a": best.pair.first,
        "submap_b": best.pair.second,
        **best.result.quality_values(),
        "verified": choice.verified,
        "agreeing": choice.agreeing,
        "tried": [f.result.quality_values() | _verdict(f) for f in found],
    }


def _verdict(found: MapRegistration) -> dict[str, Any]:
    pair = found.pair
    return {
        "submap_a": pair.first,
        "submap_b": pair.second,
        "descriptor_distance": pair.distance,
        "accepted": not found.reason,
        "reason": found.reason,
    }


def _lines(report: dict[str, Any], choice: Selection) -> list[str]:
    """The result in plain words."""
    T: NDArray[np.float64] = choice.best.T_first_second
    turned = math.degrees(float(se3.rotation_angle_rad(T[:3, :3])))
    tried = len(report["tried"])
    classes = report["class_agreement"]
    told = "" if classes is None else f", classes on {100 * classes:.0f} %"
    lines = [
        f"{tried} pair(s) of submaps registered, {choice.verified} verified, "
        f"{choice.agreeing} of them agree",
        f"submap {report['submap_b']} of B lies in submap {report['submap_a']} of A: "
        f"overlap {100 * report['overlap']:.0f} %, surfaces agree on "
        f"{100 * report['inliers']:.0f} % of it{told}; residuals {report['intensity']:.3f} in "
        f"intensity, {1000 * report['depth_m']:.1f} mm in depth at 1 m",
        f"B's world lies {np.linalg.norm(T[:3, 3]):.3f} m and {turned:.1f} degrees from A's",
    ]
    if choice.agreeing < choice.verified:
        lines.append(
            "caution: verified pairs contradict each other, as two places that look the same do; "
            "register.json has them all"
        )
    if report["no_labels_because"]:
        lines.append(f"without labels: {report['no_labels_because']}")
    return lines


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise cannot_write(folder, error) from error
