"""Construction of encoders from settings."""

from __future__ import annotations

from toolkit.base.errors import SettingsError
from toolkit.semantics.features.builtin import BuiltinEncoder, ColourHistogramEncoder
from toolkit.semantics.features.encoder import Encoder
from toolkit.semantics.features.options import FeatureOptions
from toolkit.semantics.features.sources import ViewDescriber
from toolkit.semantics.features.vlad import VladEncoder


def build_encoder(settings: FeatureOptions) -> Encoder:
    """Create the encoder selected by the settings.

    Raises:
        SettingsError: the model's folder is required but not set.
        DependencyError: transformers cannot be loaded, or the device is not available.
        FormatError: the model's folder does not contain a supported model.
    """
    if settings.kind == "vlad":
        return VladEncoder()
    if settings.kind == "colour-histogram":
        return ColourHistogramEncoder()
    if settings.kind == "builtin":
        return BuiltinEncoder()
    if settings.folder is None:
        raise SettingsError(
            "--loops.features.kind dinov2 needs --loops.features.folder DIR with a "
            "downloaded model; set it, or use --loops.features.kind builtin"
        )
    # Imported on demand, because transformers takes seconds to load.
    from toolkit.semantics.features.dinov2 import Dinov2Encoder

    return Dinov2Encoder(settings.folder)


def build_describer(settings: FeatureOptions) -> ViewDescriber:
    """Create the encoder and image source selected by the settings; raises as `build_encoder`."""
    return ViewDescriber(build_encoder(settings), settings.source)


def build_differentiable_describer(settings: FeatureOptions) -> ViewDescriber:
    """Create a describer for losses: the selected one, or the built-in encoder if the selected one
    is not differentiable; raises as `build_encoder`.
    """
    encoder = build_encoder(settings)
    return ViewDescriber(encoder if encoder.differentiable else BuiltinEncoder(), settings.source)
