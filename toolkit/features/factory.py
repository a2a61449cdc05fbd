"""The describer of views from settings."""

from __future__ import annotations

from toolkit.errors import SettingsError
from toolkit.features.builtin import BuiltinEncoder
from toolkit.features.colour_histogram import ColourHistogramEncoder
from toolkit.features.encoder import Encoder
from toolkit.features.options import FeatureOptions
from toolkit.features.sources import ViewDescriber


def build_encoder(settings: FeatureOptions) -> Encoder:
    """The encoder that the settings name.

    Raises:
        SettingsError: a folder that the kind needs is not set.
        DependencyError: transformers cannot be loaded, or the device is not there.
        FormatError: a model's folder is not what it should be.
    """
    if settings.kind == "colour-histogram":
        return ColourHistogramEncoder()
    if settings.kind == "builtin":
        return BuiltinEncoder()
    model = settings.dinov2
    if model.folder is None:
        raise SettingsError(
            "--loops.features.kind dinov2 needs --loops.features.dinov2.folder DIR with a "
            "downloaded model, or take --loops.features.kind builtin"
        )
    # Not before it is asked for: transformers takes seconds to load.
    from toolkit.features.dinov2 import Dinov2Encoder

    return Dinov2Encoder(model.folder, model.pooling, model.longest_side, model.device)


def build_describer(settings: FeatureOptions) -> ViewDescriber:
    """Encoder and source of pictures that the settings name; errors as `build_encoder`."""
    return ViewDescriber(build_encoder(settings), settings.source)
