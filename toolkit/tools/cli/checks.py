"""Checks of arguments that concern several options or the file system.

They are made before a job is imported, so that wrong arguments are reported at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from toolkit.base.errors import FormatError, RunFolderError, SettingsError
from toolkit.exports.options import FORMATS
from toolkit.io.suffixes import MESH_SUFFIXES, POINT_SUFFIXES
from toolkit.tools.cli.map_programs import EditOptions, ExportOptions
from toolkit.tools.cli.programs import (
    SEMANTIC_IMAGES,
    CompareOptions,
    EvaluateOptions,
    QueryProgram,
    RegisterOptions,
    RenderProgram,
    TrainHeadOptions,
)


def check_arguments(arguments: Any) -> None:
    """Check the parsed arguments of a job.

    Raises:
        ToolkitError: options contradict each other, or an output file has an invalid name.
    """
    check = _CHECKS.get(type(arguments))
    if check is not None:
        check(arguments)


def check_output(option: str, path: Path, suffixes: Sequence[str], what: str = "the name") -> None:
    """Check the suffix and the folder of an output file.

    Args:
        option: the option that names the file, for instance "--out".
        what: subject of the message about the suffix.

    Raises:
        FormatError: the suffix is not supported, or the folder does not exist.
        RunFolderError: it is a file of a run.
    """
    if path.suffix not in suffixes:
        raise FormatError(f"{option} {path}: {what} must end in {' or '.join(suffixes)}")
    if not path.parent.is_dir():
        raise FormatError(f"{option} {path}: there is no folder {path.parent}; create it")
    _check_no_run_file(option, path)


def _check_no_run_file(option: str, path: Path) -> None:
    """Refuse to replace a file that makes up a run, such as its map."""
    part = path.absolute().parent
    folder = part.parent.parent if part.parent.name == "parts" else part
    # Only then is the module of run folders imported, which loads torch.
    if not (folder / "frames.json").is_file():
        return
    from toolkit.runs.folder import RunFolder

    if path.name in RunFolder(folder).file_names:
        raise RunFolderError(
            f"{option} {path} is a file of the run in that folder and would be replaced; choose "
            "another name"
        )


def _check_render(options: RenderProgram) -> None:
    if options.trajectory is not None and options.view:
        raise SettingsError("give --trajectory or --view, not both")
    _check_video(options)
    semantic = [image for image in options.what if image in SEMANTIC_IMAGES]
    if semantic and not options.map.is_dir():
        raise SettingsError(
            f"--what {semantic[0]} needs a run folder, but {options.map} is not a folder"
        )


def _check_export(options: ExportOptions) -> None:
    from toolkit.runs.new_folder import NewFolder

    if options.mesh + options.points + (options.format is not None) > 1:
        raise SettingsError("give --mesh or --points or --format, not both")
    suffixes = FORMATS[options.kind]
    if suffixes:
        check_output("--to", options.to, suffixes, f"a file of {options.kind}")
    else:
        NewFolder(str(options.to), "export", options, "--to").check()


def _check_query(options: QueryProgram) -> None:
    if options.nodes and options.list:
        raise SettingsError("give names or --list, not both")
    if options.encoder or options.embedding or options.image:
        _check_search(options)
    if not options.nodes and (options.cloud or options.mesh):
        raise SettingsError("--cloud and --mesh need the names of the classes to write")
    for option, path, suffixes in (
        ("--cloud", options.cloud, POINT_SUFFIXES),
        ("--mesh", options.mesh, MESH_SUFFIXES),
        ("--summary", options.summary, (".json",)),
    ):
        if path is not None:
            check_output(option, path, suffixes)


def _check_search(options: QueryProgram) -> None:
    """Check the options of a ranking by embeddings."""
    if options.encoder is None:
        if options.image is not None:
            raise SettingsError("--image needs --encoder, the folder of a model")
        if options.nodes:
            raise SettingsError(
                "texts are compared with embeddings by --encoder, the folder of a model; give it, "
                "or --embedding alone"
            )
    elif not options.nodes and options.image is None:
        raise SettingsError("give a text or --image to search for with --encoder")
    if options.list or options.cloud or options.mesh or options.summary:
        raise SettingsError(
            "--list, --cloud, --mesh and --summary are for queries by class, not for --encoder, "
            "--image and --embedding"
        )


def _check_video(options: RenderProgram) -> None:
    from toolkit.io.video_writing import VIDEO_SUFFIXES

    if options.video is None:
        return
    check_output("--video", options.video, VIDEO_SUFFIXES)
    if options.out is not None:
        raise SettingsError("give --out for images or --video for a video, not both")
    if options.what[0] == "strip":
        raise SettingsError("--video does not show strips; choose another --what")


def _check_evaluate(options: EvaluateOptions) -> None:
    if options.mesh is not None and not options.mesh.is_file():
        raise SettingsError(f"--mesh {options.mesh} does not exist; check the path")


def _check_compare(options: CompareOptions) -> None:
    if len(options.runs) < 2:
        raise SettingsError("give at least two run folders to compare")
    check_output("--out", options.out, (".html",))
    if options.objects is None:
        if options.registration is not None or options.same_frame:
            raise SettingsError("--registration and --same-frame are for --objects FILE; give it")
        return
    check_output("--objects", options.objects, (".json",))
    if len(options.runs) != 2:
        raise SettingsError(f"--objects compares two runs, got {len(options.runs)}")
    if options.registration is not None and options.same_frame:
        raise SettingsError("give --registration or --same-frame, not both")


def _check_edit(options: EditOptions) -> None:
    from toolkit.runs.new_folder import NewFolder

    if not (options.remove or options.keep or options.move or options.recolour):
        raise SettingsError("nothing to edit; give --remove, --keep, --move or --recolour")
    NewFolder(str(options.out), "edit", options).check()


def _check_register(options: RegisterOptions) -> None:
    from toolkit.runs.new_folder import NewFolder

    NewFolder(str(options.out), "register", options).check()


def _check_train_head(options: TrainHeadOptions) -> None:
    if options.out.suffix != ".safetensors":
        raise SettingsError(f"--out must end in .safetensors, got {options.out}")


_CHECKS: dict[type, Callable[[Any], None]] = {
    RenderProgram: _check_render,
    CompareOptions: _check_compare,
    EditOptions: _check_edit,
    EvaluateOptions: _check_evaluate,
    ExportOptions: _check_export,
    QueryProgram: _check_query,
    RegisterOptions: _check_register,
    TrainHeadOptions: _check_train_head,
}
