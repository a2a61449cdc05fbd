"""Imports: every module imports, cheap ones stay cheap, and stages need few libraries."""

# Imports these packages and all their modules where only torch, numpy and OpenCV are installed, as
# on many GPU servers.
IMPORT_STAGES = """
import importlib, pkgutil, sys
for name in ("open3d", "gtsam", "faiss", "pydantic", "tyro"):
    sys.modules[name] = None  # an import of it now fails
for name in ("splatting.rendering", "splatting.alignment", "slam.tracking", "slam.mapping"):
    name = "toolkit." + name
    package = importlib.import_module(name)
    for module in pkgutil.iter_modules(package.__path__, name + "."):
        importlib.import_module(module.name)
        print(module.name)
"""

# A missing optional library is no failure: Triton exists only on Linux.
IMPORT_EVERYTHING = """
import importlib, pkgutil, toolkit
for module in pkgutil.walk_packages(toolkit.__path__, "toolkit."):
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        if error.name.partition(".")[0] == "toolkit":
            raise
    print(module.name)
"""

# Programs read the declared options before they know whether they need torch at all.
IMPORT_OPTIONS = """
import importlib, pathlib, sys
for file in sorted(pathlib.Path("toolkit").rglob("options.py")):
    importlib.import_module(".".join(file.with_suffix("").parts))
    print(file.parent.name)
heavy = {"torch", "numpy", "scipy", "cv2", "open3d", "pydantic", "tyro", "yaml"}
print(sorted(heavy & set(sys.modules)))
"""

# Of the other jobs `main` imports the arguments alone; `doctor` takes none.
HELP_OF_ALL_JOBS = """
import sys
from toolkit.tools.cli.main import JOBS, main
for job in sorted(set(JOBS) - {"doctor"}):
    for flag in ("--help", "--help-all"):
        assert main([job, flag]) == 0
heavy = {"torch", "open3d", "scipy", "cv2", "numpy", "sklearn", "faiss", "gtsam", "pydantic"}
print(sorted(heavy & set(sys.modules)))
"""

# Wrong arguments of a job whose module imports torch: values, combinations and file names.
WRONG_ARGUMENTS = """
import sys
from toolkit.tools.cli.main import main
for arguments in (
    ["run", "--out", "o", "--nothing"],
    ["evaluate", "r", "--max-views", "0"],
    ["render", "r", "--every", "0"],
    ["render", "r", "--what", "labels"],
    ["render", "r", "--trajectory", "t", "--view", "0", "0", "0", "0", "0"],
    ["export", "r", "--to", "map.ply", "--voxel-m", "0"],
    ["export", "r", "--to", "map.obj"],
    ["query", "r", "--min-confidence", "2"],
    ["query", "r", "chair", "--list"],
    ["register", "a", "b", "--out", "."],
    ["explain-loops", "r", "--nothing"],
    ["train-head", "--dataset.kind", "folder", "--dataset.path", "d", "--model", "m",
     "--out", "head.bin"],
):
    assert main(arguments) == 2, arguments
print(sorted({"torch", "open3d", "sklearn", "gtsam", "faiss"} & set(sys.modules)))
"""

IMPORT_TOOLKIT = """
import sys, toolkit, toolkit.tools.cli.main
assert set(toolkit.__all__) <= set(dir(toolkit))
heavy = {"torch", "numpy", "cv2", "open3d", "pydantic", "tyro", "rich", "sklearn"}
print(sorted(heavy & set(sys.modules)))
"""


def test_rendering_tracking_and_mapping_need_torch_numpy_and_opencv_alone(run_python):
    result = run_python("-c", IMPORT_STAGES)
    assert result.returncode == 0, result.stderr
    assert "toolkit.splatting.rendering.render\n" in result.stdout


def test_every_module_can_be_imported(run_python):
    result = run_python("-c", IMPORT_EVERYTHING)
    assert result.returncode == 0, result.stderr
    assert {"toolkit.tools.cli.run", "toolkit.base.native.loading"} < set(result.stdout.split())


def test_declared_options_need_the_standard_library_alone(run_python):
    result = run_python("-c", IMPORT_OPTIONS)
    assert result.returncode == 0, result.stderr
    *packages, heavy = result.stdout.splitlines()
    assert "tracking" in packages
    assert heavy == "[]"


def test_importing_the_toolkit_and_the_command_is_cheap(run_python):
    result = run_python("-c", IMPORT_TOOLKIT)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"


def test_wrong_arguments_are_reported_before_heavy_libraries_are_loaded(run_python):
    result = run_python("-c", WRONG_ARGUMENTS)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
    assert result.stderr.count("semsplat: error: ") == 12


def test_help_loads_no_heavy_library(run_python):
    result = run_python("-c", HELP_OF_ALL_JOBS)
    assert result.returncode == 0, result.stderr
    assert "--dataset.path" in result.stdout
    assert result.stdout.splitlines()[-1] == "[]"
