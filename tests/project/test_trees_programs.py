"""The programs that make, measure and draw class trees, as processes."""

from __future__ import annotations

from programs import run

from benchmarks.shared.results_file import read_results

DRAW = """
import sys
from toolkit.semantics.taxonomy_drawing import draw_taxonomy
from toolkit.semantics.trees import shipped_taxonomy
draw_taxonomy(shipped_taxonomy("geometric"), sys.argv[1])
print("matplotlib.pyplot" in sys.modules)
"""


def test_the_shipped_trees_are_made_again_byte_for_byte(run_python, checkout, tmp_path):
    result = run_python("data_tools/make_trees.py", "--out", str(tmp_path), PYTHONHASHSEED="7")
    assert result.returncode == 0, result.stderr
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    shipped = (checkout / "toolkit/semantics/trees").glob("*.yaml")
    assert made == {path.name: path.read_bytes() for path in shipped}


def test_the_benchmark_measures_every_list(tmp_path):
    words = ("-m", "benchmarks.semantics.trees", "widths", "--fresh", "--out", str(tmp_path))
    result = run(*words)
    assert result.returncode == 0, result.stderr
    results = read_results(tmp_path / "taxonomies.md")
    names = {name for name, *_ in results.table().rows}
    assert {"replica", "nyu40", "objects_550", "objects_1000"} <= names
    assert results.header.command == f"python {' '.join(words[:-1])} {tmp_path.name}"
    assert results.markdown() in result.stdout


def test_drawing_leaves_pyplot_alone(run_python, tmp_path):
    result = run_python("-c", DRAW, str(tmp_path / "tree.png"))
    assert result.stdout == "False\n", result.stderr
