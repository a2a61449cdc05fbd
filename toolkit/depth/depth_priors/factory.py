"""Select a source of depth priors."""

from __future__ import annotations

from collections.abc import Sequence

from toolkit.base.errors import SettingsError
from toolkit.base.geometry.camera import Camera
from toolkit.depth.depth_priors.options import DepthPriorOptions
from toolkit.depth.depth_priors.provider import DepthProvider
from toolkit.depth.depth_priors.providers.depth_maps import DepthMapFolder


def build_provider(
    options: DepthPriorOptions, stems: Sequence[str], source: Camera
) -> DepthProvider | None:
    """Build the source of depth priors, None for none.

    Args:
        stems: names of the frames' images without suffix, by frame index.
        source: intrinsics of the image files.

    Raises:
        ToolkitError: files, weights or packages are missing.
    """
    if options.kind == "none":
        return None
    if options.kind == "maps":
        return DepthMapFolder(options.maps, stems, source)
    if options.model.path is None:
        raise SettingsError(
            f"depth priors of kind '{options.kind}' need weights; set --depth-prior.model.path"
        )
    return _model(options)


def _model(options: DepthPriorOptions) -> DepthProvider:
    """Load a model; packages and weights are only imported for the kind that needs them."""
    if options.kind == "transformers":
        from toolkit.depth.depth_priors.providers.transformers_models import TransformersDepth

        return TransformersDepth(options.model)
    if options.kind in ("dust3r", "mast3r"):
        from toolkit.depth.depth_priors.providers.dust3r import PairwiseDepth

        return PairwiseDepth(options.model, options.kind)
    from toolkit.depth.depth_priors.providers.single_pass import SINGLE_PASS

    return SINGLE_PASS[options.kind](options.model)
