"""Charts as inline SVG, drawn by matplotlib in the colours of the embedding page."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup, escape
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Plot

Array = NDArray[np.float64]

# In pixels of the page, which are the points of matplotlib.
_SIZE = (640.0, 400.0)
# CSS variables of the page, which has other values of them in dark mode. matplotlib draws them in
# colours that stand for them.
_VARIABLES = (
    *("ink", "soft", "line", "card", "estimate", "truth", "second", "alarm"),
    *(f"run{number}" for number in range(6)),
)
_PLACEHOLDER = "#fe01"
_TOOLTIP = "tooltip: "


def colour(variable: str) -> str:
    """Return the colour for matplotlib that becomes a CSS variable of the page."""
    return f"{_PLACEHOLDER}{_VARIABLES.index(variable):02x}"


def tooltip(text: str) -> str:
    """Return the identifier (gid) of an artist that shows a text under the mouse."""
    return _TOOLTIP + text


# Equal drawings are equal files, and text stays text.
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "semsplat",
    "svg.fonttype": "none",
    "font.size": 13,
    "text.color": colour("soft"),
    "text.parse_math": False,
    "axes.labelcolor": colour("soft"),
    "axes.edgecolor": colour("line"),
    "axes.xmargin": 0.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": colour("line"),
    "ytick.color": colour("line"),
    "xtick.labelcolor": colour("soft"),
    "ytick.labelcolor": colour("soft"),
    "grid.color": colour("line"),
    "legend.frameon": False,
    "legend.borderaxespad": 0.0,
    "legend.columnspacing": 1.2,
    "legend.handlelength": 1.4,
    "lines.linewidth": 2,
    "lines.markeredgewidth": 2,
    "lines.markerfacecolor": colour("card"),
    "lines.markersize": 8,
    "lines.solid_capstyle": "round",
}


@dataclass(frozen=True)
class Series:
    """A line: points [N, 2], name in the legend and CSS variable of its colour."""

    points: Array
    name: str
    colour: str


@dataclass(frozen=True)
class Axes:
    """Axis labels, reference line and marks of a chart.

    Attributes:
        x_label, y_label: labels with units.
        equal: use the same scale on both axes.
        level: y value of a dashed horizontal line and its name in the legend, or None.
        marks_x: x values of short vertical marks.
        marks_name: name of the marks in the legend.
    """

    x_label: str
    y_label: str
    equal: bool = False
    level: tuple[float, str] | None = None
    marks_x: Sequence[float] = ()
    marks_name: str = ""


def line_chart(series: Sequence[Series], axes: Axes) -> Markup:
    """Return an SVG element with lines, grid, axis labels and legend.

    Non-finite points interrupt a line. Without finite points, the result is empty.
    """
    points = np.concatenate([np.empty((0, 2)), *(s.points for s in series)])
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return Markup()

    def draw(plot: Plot) -> None:
        for item in series:
            _draw_line(plot, item)
        if axes.level is not None:
            value, name = axes.level
            plot.axhline(value, color=colour("ink"), linewidth=1, dashes=(5, 4), label=name)
        if len(axes.marks_x):
            marks: dict[str, Any] = {"color": colour("alarm"), "markersize": 14, "clip_on": False}
            marks |= {"transform": plot.get_xaxis_transform(), "label": axes.marks_name}
            plot.plot(axes.marks_x, [0.97] * len(axes.marks_x), "|", **marks)
        plot.set(xlabel=axes.x_label, ylabel=axes.y_label)
        plot.grid()
        if axes.equal:
            plot.set_aspect("equal", adjustable="datalim")
        else:
            highest = max(float(points[:, 1].max()), axes.level[0] if axes.level else 0.0)
            plot.set_ylim(0.0, 1.12 * highest if highest > 0 else 1.0)

    return drawing(draw, f"{axes.y_label} over {axes.x_label}")


def drawing(draw: Callable[[Plot], None], label: str) -> Markup:
    """Return an SVG element for a page.

    Args:
        draw: draws on the axes that it is given; named artists form the legend.
        label: description for readers who do not see the drawing.
    """
    # Imported here, because a run needs matplotlib only for its report. pyplot is not used because
    # it keeps figures and settings in global state.
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    content = io.StringIO()
    with rc_context(_STYLE):
        figure = Figure(figsize=(_SIZE[0] / 72, _SIZE[1] / 72))
        FigureCanvasSVG(figure)
        plot = figure.subplots()
        draw(plot)
        # One entry for all artists of a name.
        named = dict(zip(*reversed(plot.get_legend_handles_labels()), strict=True))
        if named:
            figure.legend(named.values(), named, loc="outside upper left", ncols=_columns([*named]))
        # A figure with a layout would draw everything twice, first to lay it out.
        ConstrainedLayoutEngine().execute(figure)
        nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
        figure.savefig(content, format="svg", metadata=nothing, transparent=True)
    return _embedded(content.getvalue(), label)


def _draw_line(plot: Plot, series: Series) -> None:
    points = series.points
    style: dict[str, Any] = {"color": colour(series.colour)}
    plot.plot(*points.T, "o" if len(points) == 1 else "-", label=series.name or None, **style)
    # A point between two gaps has no line; a dot shows it.
    gap = np.pad(~np.isfinite(points).all(axis=1), 1, constant_values=True)
    plot.plot(*points[~gap[1:-1] & gap[:-2] & gap[2:]].T, "o", **style)


def _columns(names: Sequence[str]) -> int:
    """Return the columns of a legend of the width of the drawing, from typical widths of text."""
    widths = [44.0 + 7.0 * len(name) for name in names]
    return len(names) if sum(widths) <= _SIZE[0] else max(1, int(_SIZE[0] / max(widths)))


def _embedded(svg: str, label: str) -> Markup:
    """Return an SVG file of matplotlib as an element of a page."""
    svg = svg[svg.index("<svg") :]
    # HTML needs no namespaces. Several drawings on a page would have the same identifiers.
    svg = re.sub(r' xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(rf'<g id="{_TOOLTIP}([^"]*)">', r"<g><title>\1</title>", svg)
    svg = re.sub(r'<g id="[^"]*">', "<g>", svg)
    svg = re.sub(
        rf"{_PLACEHOLDER}([0-9a-f]{{2}})", lambda m: f"var(--{_VARIABLES[int(m[1], 16)]})", svg
    )
    return Markup(svg.replace("<svg", f'<svg role="img" aria-label="{escape(label)}"', 1))
