"""Build the renderer for registration; `toolkit.baselines.factory` builds the registrar."""

from __future__ import annotations

from toolkit.mapping.semantic_mapping import SemanticMapping
from toolkit.registration.options import RegistrationOptions
from toolkit.registration.views import ViewRenderer


def build_view_renderer(
    options: RegistrationOptions,
    semantics: SemanticMapping | None = None,
    backend_name: str = "auto",
) -> ViewRenderer:
    """Build the renderer of submaps for registration and its checks.

    Args:
        options: options of registration.
        semantics: decodes the features of the submaps; None disables classes.
        backend_name: rendering backend.
    """
    drawing = options.drawing
    return ViewRenderer(backend_name, semantics, drawing.min_silhouette, drawing.max_width)
