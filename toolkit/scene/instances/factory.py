"""Build the stage of instances from its options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from toolkit.base.errors import SettingsError
from toolkit.scene.instances.coco import CocoMasks
from toolkit.scene.instances.geometric import GeometricMasks
from toolkit.scene.instances.ignoring import IgnoredMasks, IgnoredTexts, MeantClasses, NearestTexts
from toolkit.scene.instances.mask_images import MaskImageFolder
from toolkit.scene.instances.masks import MaskSource
from toolkit.scene.instances.options import InstanceModelOptions, InstanceOptions
from toolkit.scene.instances.tracking import InstanceTracker
from toolkit.semantics.lexicon.matching import check_query
from toolkit.semantics.segmenters.image_folder import files_by_number, files_by_stem


def build_instances(
    options: InstanceOptions,
    class_names: Mapping[int, str] | None = None,
    stems: Sequence[str] | None = None,
    continues: bool = False,
    ignored: IgnoredTexts | None = None,
) -> InstanceTracker | None:
    """Build what tracks objects; None if instances are off, and no map is loaded.

    Args:
        options: of instances.
        class_names: names of the class ids of the run's labels; None without labels.
        stems: names of the frames' images without suffix, by frame index.
        continues: the run continues a finished map, whose objects are kept without masks too.
        ignored: what is to be ignored; None for nothing. With texts, the source of the tracker is
            `IgnoredMasks`, unless masks are geometric.

    Raises:
        SettingsError: an option is missing, or has no effect.
        DatasetError: the masks cannot be read.
        DependencyError: transformers is missing.
        FormatError: the folder of a model is invalid, or no class means an ignored text.
    """
    texts = IgnoredTexts() if ignored is None else ignored
    _check_encoder(options, texts)
    if options.model.folder is not None and options.kind != "model":
        raise SettingsError(
            f"--instances.model.folder has no effect with --instances.kind {options.kind}; add "
            "--instances.kind model, or remove it"
        )
    if options.path is not None and options.kind != "folder":
        raise SettingsError(
            f"--instances.path has no effect with --instances.kind {options.kind}; add "
            "--instances.kind folder, or remove it"
        )
    if options.kind == "none":
        return InstanceTracker(options, None) if continues else None
    source = _source(options, stems)
    if texts.texts and options.kind != "geometric":
        source = _without_ignored(source, texts, options)
    return InstanceTracker(options, source, class_names)


def may_ignore_masks(options: InstanceOptions) -> bool:
    """Whether a text that means no class of the labels may mean masks."""
    return options.kind in ("folder", "model")


def _check_encoder(options: InstanceOptions, ignored: IgnoredTexts) -> None:
    """Check that an encoder has an effect."""
    if options.encoder is None:
        return
    if not ignored.texts:
        raise SettingsError(
            "--instances.encoder has no effect without texts to compare; add --semantics.ignore, "
            "or remove it"
        )
    if options.kind != "folder" or (options.path is not None and options.path.is_file()):
        raise SettingsError(
            "--instances.encoder needs masks with embeddings: use --instances.kind folder and a "
            "folder with embeddings in .npz files, or remove it"
        )


def _without_ignored(
    source: MaskSource, ignored: IgnoredTexts, options: InstanceOptions
) -> IgnoredMasks:
    means = MeantClasses(ignored.texts, ignored.classes)
    if options.encoder is None:
        ignored.check(source)
        return IgnoredMasks(source, means)
    for text in ignored.texts:
        check_query(text)
    # Imported on demand: transformers takes seconds to load.
    from toolkit.semantics.features.pretrained.text_image import TextImageEncoder

    encoder = TextImageEncoder(options.encoder, options.model.device)
    return IgnoredMasks(source, means, NearestTexts(encoder, ignored.texts, ignored.others()))


def _source(options: InstanceOptions, stems: Sequence[str] | None) -> MaskSource:
    if options.kind == "geometric":
        return GeometricMasks()
    if options.kind == "model":
        return _model(options.model)
    path = options.path
    if path is None:
        raise SettingsError("--instances.kind folder needs the masks: add --instances.path FOLDER")
    if not path.exists():
        raise SettingsError(f"{path} does not exist; set --instances.path to the masks")
    by_stem = options.pairing == "stem" and stems is not None
    if path.is_file():
        return CocoMasks(path, stems if by_stem else None)
    files = files_by_stem(path, stems or ()) if by_stem else files_by_number(path)
    return MaskImageFolder(path, files)


def _model(options: InstanceModelOptions) -> MaskSource:
    if options.folder is None:
        raise SettingsError("--instances.kind model needs --instances.model.folder DIR")
    # Imported on demand: transformers takes seconds to load.
    from toolkit.scene.instances.models.factory import model_masks

    return model_masks(options.folder, options)
