"""Build the registrar of submaps."""

from __future__ import annotations

from toolkit.semantics.features.sources import ViewDescriber
from toolkit.slam.loops.registration.fine import FineRegistration
from toolkit.slam.loops.registration.first_order_fine import FirstOrderFineRegistration
from toolkit.slam.loops.registration.options import RegistrationOptions
from toolkit.slam.loops.registration.result import Registrar
from toolkit.slam.loops.registration.sgr import CoarseOnly, SemanticGuidedRegistration
from toolkit.slam.loops.registration.views import ViewRenderer


def build_registrar(
    options: RegistrationOptions,
    seed: int,
    renderer: ViewRenderer,
    describer: ViewDescriber | None = None,
) -> Registrar:
    """Build the registrar of submaps selected by the options.

    Args:
        seed: random seed.
        renderer: renders the submaps.
        describer: computes the view descriptors of the feature term of the first-order optimiser;
            None disables the term.
    """
    fine = build_fine(options, renderer, describer)
    if options.kind == "fine":
        return fine
    if options.kind == "coarse":
        return CoarseOnly(options, renderer, seed)
    return SemanticGuidedRegistration(options, renderer, fine, seed)


def build_fine(
    options: RegistrationOptions, renderer: ViewRenderer, describer: ViewDescriber | None = None
) -> FineRegistration:
    """Build fine registration with the optimiser selected by the options.

    Args:
        describer: see `build_registrar`.
    """
    if options.optimiser == "first-order":
        return FirstOrderFineRegistration(options, renderer, describer)
    return FineRegistration(options, renderer)


def needs_describer(options: RegistrationOptions) -> bool:
    """Whether registration uses the feature term of G-6, which needs view descriptors."""
    return options.optimiser == "first-order" and options.feature > 0
