"""Build what registration needs; `toolkit.baselines.factory` builds the registrar itself."""

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
        options: of registration.
        semantics: decodes the features of the submaps; None leaves classes out.
        backend_name: the renderer.
    """
    drawing = options.drawing
    return ViewRenderer(backend_name, semantics, drawing.min_silhouette, drawing.max_width)
