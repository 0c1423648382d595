"""Shared parts of the plots: colours, legends, labels."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

INK, GREY, BLUE, ORANGE = "#1f2328", "#8c959f", "#0969da", "#d1600a"
# Colours that stay apart for colour-blind readers (Okabe and Ito), without the black of the truth.
TRACK_COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#b8a800")
# Colour of errors in a picture: false tracks and missed objects.
WRONG = "#cf222e"
# Tracks of one colour differ in their marks and line styles.
TRACK_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
TRACK_DASHES: tuple[Any, ...] = ("solid", (0, (5, 2)), (0, (1.5, 1.5)), (0, (6, 2, 1.5, 2)))
CAMERA_COLOUR = "#6e40c9"
# Empty margin around a picture, inches.
MARGIN_IN = 0.15

STYLE: dict[Any, Any] = {
    "svg.hashsalt": "stereophd",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 11.5,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e8eb",
    "grid.linewidth": 0.8,
    "legend.frameon": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "savefig.dpi": 150.0,
}


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, which no window shows."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def plots_named(paths: Mapping[str, Path]) -> list[str]:
    """Return the plots that files such as ``ospa.svg`` show, each once."""
    return list(dict.fromkeys(name.rsplit(".", 1)[0] for name in paths))


def save_figures(figures: Mapping[str, Figure], paths: Mapping[str, Path], **options: Any) -> None:
    """Write figures, by plot, as the files that `paths` names: png or svg; to be called in the style they have."""
    boxes = {plot: _lay_out(figure) for plot, figure in figures.items()}
    for name, path in paths.items():
        plot, kind = name.rsplit(".", 1)
        # Metadata of the files (date, program) would differ between runs.
        metadata: dict[str, Any] = {"Date": None} if kind == "svg" else {"Software": None}
        figures[plot].savefig(path, format=kind, metadata=metadata, bbox_inches=boxes[plot], **options)


def _lay_out(figure: Figure) -> Bbox:
    """Arrange a figure once, for all its files, each of which would do so again; return its extent, inches.

    Panels without a layout have fixed room, and only the title is beside them: to find out what they need takes as long
    as a file.
    """
    if (engine := figure.get_layout_engine()) is None:
        titles = [text.get_window_extent().transformed(figure.dpi_scale_trans.inverted()) for text in figure.texts]
        return Bbox.union([figure.bbox_inches, *titles]).padded(MARGIN_IN)
    engine.execute(figure)
    figure.set_layout_engine(None)
    return figure.get_tightbbox().padded(MARGIN_IN)


def colour_of(number: int) -> str:
    """Return the colour of a track."""
    return TRACK_COLOURS[number % len(TRACK_COLOURS)]


def marker_of(number: int) -> str:
    """Return the mark of a track: one for each round of the colours."""
    return TRACK_MARKERS[number // len(TRACK_COLOURS) % len(TRACK_MARKERS)]


def dash_of(number: int) -> Any:
    """Return the line style of a track: one for each round of the colours."""
    return TRACK_DASHES[number // len(TRACK_COLOURS) % len(TRACK_DASHES)]


def legend_right(axes: Axes, order: Sequence[str] = ()) -> None:
    """Put the legend beside the axes, outside of the data; labels that start as in `order` come first."""
    handles, labels = axes.get_legend_handles_labels()
    ranks = [next((i for i, start in enumerate(order) if one.startswith(start)), len(order)) for one in labels]
    chosen = sorted(range(len(labels)), key=lambda i: ranks[i])
    axes.legend(
        [handles[i] for i in chosen],
        [labels[i] for i in chosen],
        loc="upper left",
        bbox_to_anchor=(1.01, 1.0),
        borderaxespad=0.0,
    )


def bracketed(unit: str) -> str:
    """Return a unit as it follows the name of an axis."""
    return f" [{unit.strip()}]" if unit else ""
