"""Draws what searches for swings come to against the time that they have.

python docs/make_curves.py docs/images
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

ROWS = Path(__file__).parent.parent / "benchmarks" / "results" / "swings.jsonl"
METHODS = ("adam", "cem+adam", "lbfgs", "cem", "cmaes", "random")
PANELS = (
    ("whip-target", "within_1_cm", 100, "targets met within 1 cm [%]"),
    ("whip", "score", 1, "mean score"),
)


def main() -> None:
    """Draw swings.png into the folder that is told."""
    rows = [json.loads(line) for line in ROWS.read_text().splitlines()]
    figure = Figure((9.0, 3.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (task, value, scale, label) in zip(figure.subplots(1, 2), PANELS, strict=True):
        for method in METHODS:
            mine = [row for row in rows if (row["task"], row["method"]) == (task, method)]
            points = sorted((row["seconds"], scale * row[value]) for row in mine)
            style = "-o" if "adam" in method or method == "lbfgs" else "--s"
            axes.plot(*zip(*points, strict=True), style, label=method, markersize=4)
        axes.set(title=task, xlabel="CPU seconds a goal", ylabel=label, ylim=(0, 1.05 * scale))
        axes.grid(alpha=0.3)
    axes.legend(fontsize="small", loc="lower right")
    figure.savefig(Path(sys.argv[1]) / "swings.png", metadata={"Software": None})


if __name__ == "__main__":
    main()
