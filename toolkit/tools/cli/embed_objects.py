"""`semsplat embed-objects`: embed the objects of a labelled map for queries by text and image."""

from __future__ import annotations

import logging

import numpy as np

from toolkit.base.errors import RunFolderError, SettingsError
from toolkit.io.object_embeddings import OBJECTS, write_objects
from toolkit.runs.maps.labelled import load_labelled_run
from toolkit.runs.maps.object_embedding import EmbeddingOptions, embed_objects
from toolkit.scene.graph.scene import SceneReader
from toolkit.semantics.features.pretrained.text_image import TextImageEncoder
from toolkit.semantics.options import ObjectOptions
from toolkit.semantics.product_quantisation import compress
from toolkit.tools.cli.map_programs import EmbedObjectsOptions

_log = logging.getLogger(__name__)


def main(options: EmbedObjectsOptions) -> int:
    """Write the embeddings of objects into the run folder.

    Returns:
        0.

    Raises:
        ToolkitError: there is no finished run with labels, the run has embeddings already, the
            dataset or the model cannot be read, or the file cannot be written.
    """
    file = options.run / OBJECTS
    if file.exists() and not options.replace:
        raise RunFolderError(f"{file} exists; replace it with --replace")
    labelled = load_labelled_run(options.run)
    encoder = TextImageEncoder(options.encoder, options.device)
    if options.codes and encoder.dimensions % options.codes:
        raise SettingsError(
            f"--codes {options.codes} does not divide the {encoder.dimensions} values of the "
            "embeddings of this model"
        )
    dataset = labelled.run.open_dataset(options.dataset)
    extraction = ObjectOptions(options.link_m, options.min_gaussians, options.min_confidence)
    # The order, and so the ids, are those of `semsplat query --summary`.
    reader = SceneReader(labelled.map, extraction, np.zeros(3))
    found = labelled.map.objects(None, reader.ground, extraction)
    limits = EmbeddingOptions(options.max_keyframes, options.max_views)
    objects = embed_objects(labelled, found, dataset, encoder, limits)
    compressed = compress(objects.embeddings, options.codes) if options.codes else None
    write_objects(file, objects, compressed)
    _log.info("Wrote %d objects to %s (%d bytes).", len(objects), file, file.stat().st_size)
    return 0
