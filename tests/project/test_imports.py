"""What an import may cost, and what it may need."""

# Importing these packages and every module of them, but for the factories: they alone
# read settings, and a GPU server without pydantic calls the constructors.
IMPORT_STAGES = """
import importlib, pkgutil, sys
for name in ("open3d", "gtsam", "faiss", "pydantic", "tyro"):
    sys.modules[name] = None  # an import of it now fails
for name in ("toolkit.rendering", "toolkit.tracking", "toolkit.mapping"):
    package = importlib.import_module(name)
    for module in pkgutil.iter_modules(package.__path__, name + "."):
        if not module.name.endswith(".factory"):
            importlib.import_module(module.name)
            print(module.name)
"""

IMPORT_TOOLKIT = """
import sys, toolkit, toolkit.cli.main
heavy = {"torch", "numpy", "cv2", "open3d", "pydantic", "tyro", "rich", "sklearn"}
print(sorted(heavy & set(sys.modules)))
"""


def test_rendering_tracking_and_mapping_need_torch_numpy_and_opencv_alone(run_python):
    result = run_python("-c", IMPORT_STAGES)
    assert result.returncode == 0, result.stderr
    assert "toolkit.rendering.render\n" in result.stdout


def test_importing_the_toolkit_and_the_command_is_cheap(run_python):
    result = run_python("-c", IMPORT_TOOLKIT)
    assert result.returncode == 0, result.stderr
    assert result.stdout.strip() == "[]"
