"""Register the maps of two finished runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from toolkit.base.errors import FormatError, SettingsError, ToolkitError
from toolkit.base.geometry import se3
from toolkit.io.guarded.documents import read_json
from toolkit.runs.maps.finished import FinishedRun
from toolkit.runs.maps.merged_map import shared_semantics
from toolkit.semantics.features.factory import build_differentiable_describer
from toolkit.slam.loops.registration.factory import build_registrar, needs_describer
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.views import ViewRenderer
from toolkit.slam.loops.two_maps import (
    MapRegistration,
    most_similar_submaps,
    register_submaps,
    select_registration,
)
from toolkit.slam.submaps.store import SavedSubmaps

# Number of pairs of submaps that are registered, as in `semsplat register`.
_PAIRS = 6


def register_runs(
    a: FinishedRun, b: FinishedRun, pairs: int, options: RegistrationOptions
) -> list[MapRegistration]:
    """Register the most similar submaps of two runs.

    Args:
        a: the run that defines the frame.
        b: the run that is moved.
        pairs: number of pairs of submaps.
        options: options of the registration.

    Raises:
        ToolkitError: submaps cannot be read, or their descriptors cannot be compared.
    """
    submaps = a.submaps, b.submaps
    _check_descriptors(a, b, *submaps)
    renderer = ViewRenderer(a.settings.backend, shared_semantics(a, b))
    describer = None
    if needs_describer(options):
        describer = build_differentiable_describer(a.settings.loops.features)
    registrar = build_registrar(options, a.settings.seed, renderer, describer)
    similar = most_similar_submaps(*submaps, pairs)
    return [
        register_submaps(pair, *submaps, registrar)
        for pair in tqdm(similar, unit="pair of submaps", disable=None)
    ]


def relative_pose(a: FinishedRun, b: FinishedRun, registration: Path | None) -> NDArray[np.float64]:
    """Return T_a_b [4, 4] from a register.json, or by registering both maps.

    Raises:
        ToolkitError: the file cannot be used, or no registration can be verified.
    """
    if registration is not None:
        return read_registration(registration, a.folder.path, b.folder.path)
    selection = select_registration(register_runs(a, b, _PAIRS, RegistrationOptions()))
    if selection is None:
        raise ToolkitError(
            f"no registration of {b.folder.path} with {a.folder.path} can be verified; try "
            "semsplat register with more --pairs and give its register.json with --registration"
        )
    return selection.best.T_first_second


def read_registration(path: Path, run_a: Path, run_b: Path) -> NDArray[np.float64]:
    """Return T_a_b [4, 4] of two runs from the register.json that `semsplat register` wrote.

    Raises:
        FormatError: the file is missing or damaged, or belongs to other runs.
    """
    try:
        content = read_json(path)
        T_a_b = np.array(content["T_a_b"], np.float64).reshape(4, 4)
        runs = [Path(content[key]).resolve() for key in ("run_a", "run_b")]
    except OSError as error:
        raise FormatError(f"cannot read {path} ({error.strerror}); check the path") from error
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{path} is not a register.json; write one with: semsplat register"
        ) from error
    if not se3.is_rigid(T_a_b):
        raise FormatError(f"{path}: T_a_b is not a rigid motion; register the runs again")
    given = [run_a.resolve(), run_b.resolve()]
    if runs == given[::-1]:
        return se3.inverse(T_a_b)
    if runs != given:
        raise FormatError(
            f"{path} belongs to {content['run_a']} and {content['run_b']}; register {run_a} and "
            f"{run_b} with: semsplat register"
        )
    return T_a_b


def _check_descriptors(
    a: FinishedRun, b: FinishedRun, submaps_a: SavedSubmaps, submaps_b: SavedSubmaps
) -> None:
    """Check that the keyframes of both runs have comparable descriptors."""
    lengths = []
    for run, submaps in ((a, submaps_a), (b, submaps_b)):
        length = max(submap.descriptors.shape[1] for submap in submaps.values())
        if not length:
            raise SettingsError(
                f"the keyframes of {run.folder.path} have no descriptors for place recognition; "
                f"{run.descriptor_remedy}"
            )
        lengths.append(length)
    features_a, features_b = a.settings.loops.features, b.settings.loops.features
    if lengths[0] != lengths[1] or features_a != features_b:
        raise SettingsError(
            f"the descriptors of {a.folder.path} ({_described(features_a, lengths[0])}) and "
            f"{b.folder.path} ({_described(features_b, lengths[1])}) cannot be compared; run one "
            "of them again with the other's --loops.features"
        )


def _described(features: Any, length: int) -> str:
    return f"loops.features.kind {features.kind}, source {features.source}, length {length}"
