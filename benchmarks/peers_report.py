"""What the search found: the cheapest believable setting of each engine, a table, and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
from peers_measures import believable
from peers_rows import PACKAGES
from peers_settings import BLOCKS, SCENES, is_original

__all__ = ["TOLERANCE", "between_table", "cheapest", "draw", "error", "front", "picks", "table"]

MOST_TIMED = 5
LANES = "ours, 8 lanes"
SHIPPED = ", as shipped"
ORIGINAL = ", as the original"
TOLERANCE = {
    "cable": 0.5,
    "heap": 7.0,
    "ring": 3.0,
    "block": 0.5,
    "tower": 1.5,
    "fold10": 7.0,
    "fold25": 7.0,
    "crumple10": 4.0,
    "crumple25": 4.0,
    "shell-cube": 7.0,
}
"""Error up to which settings count as equal [mm]."""
_AT_THE_END = ("cable", "block", "tower")  # their places then do not depend on chance
_COLOURS = {
    "ours": "black",
    LANES: "tab:grey",
    "mujoco": "tab:blue",
    "newton-vbd": "tab:green",
    "newton-xpbd": "tab:olive",
    "pybullet": "tab:red",
    "pybullet, as the original": "tab:pink",
}


def error(row: dict[str, Any]) -> float:
    """Of a row against its engine's own fine solution [mm]; infinite where it is not finite."""
    name = "end_mm" if row["scene"] in _AT_THE_END else "early_mm"
    return float(row["errors"].get(name, float("inf")))


def label(row: dict[str, Any]) -> str:
    """The engine; ours in lanes apart, and PyBullet at the settings of the original environment."""
    lanes = row["settings"].get("lanes", 1)
    original = ORIGINAL if is_original(row["engine"], row["scene"], row["settings"]) else ""
    return row["engine"] + (f", {lanes} lanes" if lanes > 1 else original)


def front(rows: list[dict[str, Any]], engine: str) -> list[dict[str, Any]]:
    """Of an engine's believable rows those that no other beats in both cost and error.

    Ours keeps all of its steps, alone and in lanes, and PyBullet the original's settings.
    """
    mine = [row for row in rows if row["engine"] == engine and row["errors"]["finite"]]
    if engine == "ours":
        return mine
    original = [row for row in mine if label(row).endswith(ORIGINAL)]
    mine = [row for row in mine if row not in original]
    best: list[dict[str, Any]] = []
    for row in sorted(filter(believable, mine), key=lambda row: row["ms"]):
        if not best or error(row) < 0.9 * error(best[-1]):
            best.append(row)
    if len(best) > MOST_TIMED:
        # the cheapest, the most exact, and some between them
        step = (len(best) - 1) / (MOST_TIMED - 1)
        kept = [best[round(k * step)] for k in range(MOST_TIMED)]
        equal = cheapest(best, TOLERANCE[best[0]["scene"]])
        best = kept if equal is None or equal in kept else [*kept, equal]
    return [*best, *original]


def cheapest(rows: list[dict[str, Any]], most: float) -> dict[str, Any] | None:
    """The cheapest believable row with an error up to `most` [mm]."""
    fit = [row for row in rows if believable(row) and error(row) <= most]
    return min(fit, key=lambda row: row["ms"], default=None)


def picks(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """A flat row for every scene and engine, from what was timed.

    It is the cheapest believable setting whose error is within the scene's tolerance or, of an
    engine that has none, its most exact believable one; `equal` tells them apart. `least_ms` is of
    the cheapest believable one, whatever its error. Ours also has rows of its tasks' substep, and
    PyBullet one of the original's settings, believable or not.
    """
    out = []
    for scene in SCENES:
        timed = [row for row in rows if row["kind"] == "time" and row["scene"] == scene]
        engines: dict[str, list[dict[str, Any]]] = {}
        for row in timed:
            if believable(row) or label(row).endswith(ORIGINAL):
                engines.setdefault(label(row), []).append(row)
        found = {name: cheapest(of, TOLERANCE[scene]) for name, of in engines.items()}
        shown = {name: found[name] or _most_exact(of) for name, of in engines.items()}
        ours = {name: row["ms"] for name, row in found.items() if row and name.startswith("ours")}
        shipped = {
            label(row) + SHIPPED: [row]
            for row in timed
            if _as_shipped(row) and row is not shown.get(label(row))
        }
        found |= {name: cheapest(of, TOLERANCE[scene]) for name, of in shipped.items()}
        engines |= shipped
        least = {
            name: min((row["ms"] for row in of if believable(row)), default=None)
            for name, of in engines.items()
        }
        picked = {name: found[name] or _most_exact(of) for name, of in engines.items()}
        # peers by cost, then ours
        for name, row in sorted(picked.items(), key=lambda each: _place(*each)):
            out.append(
                {
                    "scene": scene,
                    "engine": name,
                    "settings": _settings(row),
                    "equal": found[name] is not None,
                    "believable": believable(row),
                    "ms": row["ms"],
                    "error_mm": error(row),
                    "stretch_end": row["errors"].get("stretch_end"),
                    "pierced_percent": row["errors"].get("pierced_percent"),
                    "times_ours": row["ms"] / ours["ours"] if "ours" in ours else None,
                    "times_lanes": row["ms"] / ours[LANES] if LANES in ours else None,
                    "least_ms": least[name],
                    "least_times_ours": _ratio(least[name], least.get("ours")),
                }
            )
    return out


def _place(name: str, row: dict[str, Any]) -> tuple[bool, bool, float]:
    ours = name.startswith("ours")
    return ours, name.endswith(SHIPPED), "lanes" in name if ours else row["ms"]


def _most_exact(rows: list[dict[str, Any]]) -> dict[str, Any]:
    return min(rows, key=lambda row: (error(row), row["ms"]))


def _ratio(cost: float | None, ours: float | None) -> float | None:
    return None if cost is None or ours is None else cost / ours


def _as_shipped(row: dict[str, Any]) -> bool:
    """Whether it is ours, with the substep of its tasks."""
    return bool(row["engine"] == "ours" and row["settings"]["hz"] == 1200)


def _settings(row: dict[str, Any]) -> str:
    values = row["settings"]
    if row["engine"] == "ours":
        return f"{values['hz']} Hz"
    if "substeps" in values:
        parts = [f"{60 * values['substeps']} Hz x {values['iterations']}"]
        names = _newton_names(row["engine"], row["scene"])
    else:
        solver = f", {values['solver']}" if "solver" in values else ""
        parts = [f"{values['hz']} Hz{solver} x {values['iterations']}"]
        names = ("world",) if row["engine"] == "pybullet" else ("contact", "tolerance")
        if row["engine"] == "mujoco":
            links = row["scene"] in ("cable", "heap", "ring")
            names = (*names, *(("links",) if links else ()))
            parts += ["sleep"] if values.get("sleep") else []
            parts += ["elliptic"] if values["cone"] == "elliptic" else []
    return ", ".join(
        [*parts, *(f"{k.replace('_', ' ')} {_short(values[k])}" for k in names if k in values)]
    )


def _newton_names(engine: str, scene: str) -> tuple[str, ...]:
    """Settings that the solver reads in such a scene."""
    if engine == "newton-xpbd":
        return ()
    if scene in BLOCKS:
        return ("contact_stiffness", "contact_damping")
    return ("beads", "link_stiffness", "contact_damping", "stiffness")


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def table(rows: list[dict[str, Any]]) -> str:
    """The picks as a Markdown table."""
    lines = [
        "| scene, error up to | engine | settings | error, mm | stretch | pierced, % | ms | / ours "
        "| / ours in lanes | believable at all, ms | / ours |",
        "|---" * 11 + "|",
    ]
    for row in picks(rows):
        cells = [
            f"{row['scene']}, {TOLERANCE[row['scene']]:g} mm",
            row["engine"],
            row["settings"],
            _error(row),
            _cell(row["stretch_end"], ".3f"),
            _cell(row["pierced_percent"], ".1f"),
            _cell(row["ms"], ".3g"),
            _cell(row["times_ours"], ".1f"),
            _cell(row["times_lanes"], ".1f"),
            _cell(row["least_ms"], ".3g"),
            _cell(row["least_times_ours"], ".1f"),
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def between_table(rows: list[dict[str, Any]]) -> str:
    """How far the peers' fine solutions are from ours [mm], when errors are read."""
    names = [name for name in _COLOURS if name in PACKAGES and name != "ours"]
    found = {
        (row["scene"], row["engine"]): f"{error(row):.2g}" if row["errors"]["finite"] else "none"
        for row in rows
        if row["kind"] == "between"
    }
    lines = [f"| scene | {' | '.join(names)} |", "|---" * (1 + len(names)) + "|"]
    for scene in SCENES:
        cells = [found.get((scene, name), "-") for name in names]
        if any((scene, name) in found for name in names):
            lines.append(f"| {scene} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _error(row: dict[str, Any]) -> str:
    known = row["error_mm"] < float("inf")
    value = f"{row['error_mm']:.2g}" if known else "not measured"
    if not row["believable"]:
        return f"{value} (not believable)"
    return value if row["equal"] or not known else f"{value} (more)"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form if value < 1000 else ",.0f")


def draw(rows: list[dict[str, Any]], path: Path) -> None:
    """Error over cost, a panel a scene: lines are what was timed, crosses are not believable.

    What has no known error is left out.
    """
    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    timed = [row for row in rows if row["kind"] == "time" and error(row) < float("inf")]
    scenes = [scene for scene in SCENES if any(row["scene"] == scene for row in timed)]
    columns = min(3, len(scenes))
    lines = -(-len(scenes) // columns)
    figure, panels = pyplot.subplots(
        lines, columns, figsize=(4.2 * columns, 3.4 * lines), layout="constrained", squeeze=False
    )
    for panel, scene in zip(panels.flat, scenes, strict=False):
        for name, colour in _COLOURS.items():
            mine = sorted(
                (row for row in timed if row["scene"] == scene and label(row) == name),
                key=lambda row: row["settings"]["hz"] if row["engine"] == "ours" else row["ms"],
            )
            if not mine:
                continue
            style = "--" if "lanes" in name else "-"
            panel.loglog(
                [row["ms"] for row in mine], [error(row) for row in mine], style, color=colour,
                label=name, linewidth=1.2,
            )  # fmt: skip
            for fits, mark in ((True, "o"), (False, "x")):
                of = [row for row in mine if believable(row) == fits]
                panel.loglog(
                    [row["ms"] for row in of], [error(row) for row in of], mark, color=colour,
                    markersize=4,
                )  # fmt: skip
        panel.axhline(TOLERANCE[scene], color="0.8", linewidth=0.8, zorder=0)
        panel.set_title(scene)
        panel.grid(which="major", alpha=0.3)
        panel.tick_params(labelsize=8)
        for axis in (panel.xaxis, panel.yaxis):
            axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0), numticks=20))
            axis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(ticker.NullFormatter())
    for panel in list(panels.flat)[len(scenes) - columns : len(scenes)]:
        panel.set_xlabel("CPU ms per simulated second and world")
    for panel in panels[:, 0]:
        panel.set_ylabel("error, mm")
    for panel in list(panels.flat)[len(scenes) :]:
        panel.set_visible(False)
    shown = {}
    for panel in panels.flat[: len(scenes)]:
        lines_of, names = panel.get_legend_handles_labels()
        shown |= dict(zip(names, lines_of, strict=True))
    figure.legend(
        list(shown.values()), list(shown), loc="outside lower center", ncols=len(shown), fontsize=8
    )
    figure.savefig(path, dpi=110)
    pyplot.close(figure)
