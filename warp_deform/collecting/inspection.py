"""Look into datasets: a contact sheet of an episode, and statistics of a folder."""

from __future__ import annotations

import math
import statistics as stats
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ..episodes import Episode, EpisodeReader, Step, combine_hashes, episode_name
from ..episodes.corrected import is_corrected, labels_of
from ..episodes.enclosed import ENCLOSED, enclosed_count
from ..errors import InputError
from ..rendering.pixels import SHAPE, TABLE_GRID, PixelGrid
from ..tasks.registry import is_known
from ..tasks.registry import task as find_task

__all__ = ["contact_sheet", "statistics"]

_MAX_ROWS = 100
_CAPTION_WIDTH, _HEADER_HEIGHT, _GAP, _LINE = 290, 70, 8, 20
_MIN_ROW_HEIGHT = 12 * _LINE
_PAPER, _INK, _FAINT = (255, 255, 255), (25, 25, 25), (115, 115, 115)
_GOOD, _BAD = (20, 120, 40), (200, 30, 30)
_PICK, _ARROW = (255, 255, 255), (255, 225, 0)
_LABEL, _LABEL_INK = (255, 90, 255), (160, 20, 160)
"""What a teacher would have done, in the picture and beside it."""
_SUBPIXEL_BITS = 4


def contact_sheet(episode: Episode, path: Path, *, scale: int = 1) -> None:
    """Write a PNG with a row per step: caption, colour, height, and the goal's pair if any.

    The colour picture carries the action taken from it: a ring at the pick, an arrow to the place,
    and at each end a stroke along its yaw. Heights are in false colours, dark blue at 0 and dark
    red at the episode's largest. Picture rows are y, columns x, as a policy sees them. Equal
    episodes give equal files.

    Args:
        episode: at most 100 rows.
        path: ends in .png; its folder exists.
        scale: whole number of drawn pixels per observed one.

    Raises:
        InputError: the path is no PNG in an existing folder, or the episode is too long.
    """
    import cv2

    path = Path(path)
    if path.suffix.lower() != ".png" or not path.parent.is_dir():
        raise InputError(f"{path} must end in .png and lie in a folder that exists")
    if len(episode.steps) > _MAX_ROWS:
        raise InputError(f"a contact sheet takes {_MAX_ROWS} rows, not {len(episode.steps)}")
    if scale < 1:
        raise InputError(f"scale {scale} must be a whole number from 1")
    maps = [step.height for step in episode.steps]
    if episode.goal is not None:
        maps.append(episode.goal.height)
    # Below 1 mm the colours would show rounding.
    top = max(0.001, *(float(heights.max()) for heights in maps))
    rows = [_draw_row(episode, t, top=top, scale=scale) for t in range(len(episode.steps))]
    header = _draw_header(episode, top=top, width=rows[0].shape[1])
    sheet = np.concatenate([header, *rows])
    done, data = cv2.imencode(".png", cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR))
    if not done:
        raise RuntimeError(f"OpenCV cannot encode a picture of shape {sheet.shape}")
    path.write_bytes(data.tobytes())


def statistics(folder: Path) -> dict[str, Any]:
    """Return a summary of a folder of episodes, read from their metadata alone.

    Keys: `episodes`, `steps` (actions taken), `successes`, `success_rate`, `mean_actions`,
    `median_actions`, `mean_score`, `physics_ok` (episodes whose guards held), `discarded_starts`,
    `sim_seconds`, `bytes`, `tasks`, `demonstrators` and `robots` (episodes of each), `state_hash`
    (of the episodes in seed order); where bags have items also `enclosed`, the episodes whose bag
    enclosed them.

    Raises:
        InputError: the folder has no episodes, or one cannot be read.
    """
    reader = EpisodeReader(folder)
    actions, scores, seconds, hashes, infos = [], [], [], [], []
    successes = sound = discarded = size = 0
    tasks, demonstrators, robots = Counter[str](), Counter[str](), Counter[str]()
    for seed in reader.seeds:
        info = reader.info(seed)
        infos.append(info)
        actions.append(info.actions)
        scores.append(info.score)
        seconds.append(info.sim_seconds)
        hashes.append(info.state_hash)
        successes += info.success
        sound += info.physics_ok
        discarded += info.discarded_starts
        size += reader.path(seed).stat().st_size
        tasks[info.task] += 1
        demonstrators[info.demonstrator] += 1
        robots[info.robot] += 1
    count, enclosed = len(reader), enclosed_count(infos)
    return {
        "episodes": count,
        "steps": sum(actions),
        "successes": successes,
        "success_rate": successes / count,
        "mean_actions": sum(actions) / count,
        "median_actions": float(stats.median(actions)),
        "mean_score": math.fsum(scores) / count,
        "physics_ok": sound,
        "discarded_starts": discarded,
        "sim_seconds": math.fsum(seconds),
        "bytes": size,
        "tasks": dict(sorted(tasks.items())),
        "demonstrators": dict(sorted(demonstrators.items())),
        "robots": dict(sorted(robots.items())),
        "state_hash": combine_hashes(hashes),
        **({} if enclosed is None else {ENCLOSED: enclosed}),
    }


def _draw_row(episode: Episode, t: int, *, top: float, scale: int) -> np.ndarray:
    step = episode.steps[t]
    color = _enlarge(step.color, scale)
    label = None
    if step.action is not None:
        _draw_action(color, step.action, _grid(episode.info.task))
        if is_corrected(episode.info.demonstrator):
            label = labels_of(episode.info, what=episode_name(episode.info.seed))[t]
    if label is not None:
        _draw_action(color, label, _grid(episode.info.task), pick=_LABEL, arrow=_LABEL)
    panels = [color, _false_color(_enlarge(step.height, scale), top)]
    if episode.goal is not None:
        panels += [
            _enlarge(episode.goal.color, scale),
            _false_color(_enlarge(episode.goal.height, scale), top),
        ]
    rows, columns = color.shape[:2]
    width = _GAP + _CAPTION_WIDTH + len(panels) * (columns + _GAP)
    canvas = np.full((max(rows, _MIN_ROW_HEIGHT) + _GAP, width, 3), _PAPER, np.uint8)
    caption = _caption(step, t, last=episode.info.actions)
    if label is not None:
        x, y, _, to_x, to_y, *_ = label
        caption.append((f"teacher {x:.3f} {y:+.3f}, {to_x:.3f} {to_y:+.3f} m", _LABEL_INK))
    for line, (text, ink) in enumerate(caption):
        _write(canvas, text, x=_GAP, y=(line + 1) * _LINE, ink=ink)
    for index, panel in enumerate(panels):
        left = _GAP + _CAPTION_WIDTH + index * (columns + _GAP)
        canvas[:rows, left : left + columns] = panel
    return canvas


def _caption(step: Step, t: int, *, last: int) -> list[tuple[str, tuple[int, int, int]]]:
    lines = [
        (f"row {t} of {last}", _INK),
        (f"score {step.score:.3f}", _INK),
        ("success", _GOOD) if step.success else ("not solved", _FAINT),
        ("physics ok", _FAINT) if step.physics_ok else ("PHYSICS NOT OK", _BAD),
        (f"simulated {step.sim_seconds:.2f} s", _FAINT),
        (f"state {step.state_hash[:12] or '-'}", _FAINT),
    ]
    if step.action is not None:
        pick_x, pick_y, pick_yaw, place_x, place_y, place_yaw, lift = step.action
        lines += [
            ("", _INK),
            (f"pick  {pick_x:.3f} {pick_y:+.3f} m, {math.degrees(pick_yaw):+.0f} deg", _INK),
            (f"place {place_x:.3f} {place_y:+.3f} m, {math.degrees(place_yaw):+.0f} deg", _INK),
            (f"lift  {lift:.3f} m", _INK),
            (str(step.outcome), _GOOD if step.outcome == "placed" else _BAD),
        ]
    return lines


def _draw_header(episode: Episode, *, top: float, width: int) -> np.ndarray:
    info = episode.info
    canvas = np.full((_HEADER_HEIGHT, width, 3), _PAPER, np.uint8)
    title = f"{info.task}, seed {info.seed}: {'success' if info.success else 'failure'}"
    _write(canvas, title, x=_GAP, y=_LINE, ink=_GOOD if info.success else _BAD)
    details = f"score {info.score:.3f}, {info.actions} actions, {info.demonstrator}, {info.robot}"
    _write(canvas, details, x=_GAP, y=2 * _LINE, ink=_INK)
    names = "color | height"
    if episode.goal is not None:
        names += f" | goal color | goal height ({episode.goal.kind})"
    _write(canvas, names, x=_GAP + _CAPTION_WIDTH, y=3 * _LINE, ink=_FAINT)
    ramp = np.tile(np.linspace(0.0, top, 100, dtype=np.float32), (10, 1))
    canvas[3 * _LINE - 10 : 3 * _LINE, _GAP : _GAP + 100] = _false_color(ramp, top)
    _write(canvas, f"height 0 to {1000 * top:.1f} mm", x=_GAP + 108, y=3 * _LINE, ink=_FAINT)
    return canvas


def _grid(task: str) -> PixelGrid:
    """Where the pixels of a task's pictures are; of a task from elsewhere, the benchmark's."""
    return find_task(task).grid if is_known(task) else TABLE_GRID


def _draw_action(
    color: np.ndarray,
    action: np.ndarray,
    grid: PixelGrid,
    *,
    pick: tuple[int, int, int] = _PICK,
    arrow: tuple[int, int, int] = _ARROW,
) -> None:
    """Draw pick, place and their yaws onto an image, (H, W, 3), that shows the workspace."""
    import cv2

    rows, columns = color.shape[:2]
    pixels_per_metre = np.array([columns / SHAPE[1], rows / SHAPE[0]]) / grid.pixel_size

    def to_pixel(xy: np.ndarray) -> tuple[int, int]:
        fixed = (xy - grid.origin) * pixels_per_metre * 2**_SUBPIXEL_BITS
        fixed = fixed.clip(-(2**20), 2**20)  # far outside of the picture; OpenCV takes 32 bits
        return round(fixed[0]), round(fixed[1])

    start, end_point = to_pixel(action[0:2]), to_pixel(action[3:5])
    length = math.dist(start, end_point) / 2**_SUBPIXEL_BITS
    # Twice, dark and wide below bright and narrow: the marks show on every background.
    for ink, width in ((_INK, 3), (None, 1)):
        style = {"thickness": width, "lineType": cv2.LINE_AA, "shift": _SUBPIXEL_BITS}
        for end, yaw in ((action[0:2], action[2]), (action[3:5], action[5])):
            stroke = 0.02 * np.array([math.cos(yaw), math.sin(yaw)])
            cv2.line(color, to_pixel(end - stroke), to_pixel(end + stroke), ink or pick, **style)
        cv2.circle(color, start, 5 << _SUBPIXEL_BITS, ink or pick, **style)
        head = {"thickness": width, "line_type": cv2.LINE_AA, "shift": _SUBPIXEL_BITS}
        if length > 0:
            tip = min(0.5, 9.0 / length)
            cv2.arrowedLine(color, start, end_point, ink or arrow, tipLength=tip, **head)


def _enlarge(image: np.ndarray, scale: int) -> np.ndarray:
    """Return a copy with every pixel repeated `scale` times along both sides."""
    return np.repeat(np.repeat(image, scale, axis=0), scale, axis=1)


def _false_color(heights: np.ndarray, top: float) -> np.ndarray:
    """Return heights [m], (H, W), as RGB on a scale from 0 to `top` [m]."""
    import cv2

    levels = np.rint(np.clip(heights / top, 0.0, 1.0) * 255).astype(np.uint8)
    return np.asarray(
        cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    )


def _write(canvas: np.ndarray, text: str, *, x: int, y: int, ink: tuple[int, int, int]) -> None:
    import cv2

    # OpenCV's stroke fonts have ASCII only.
    text = text.encode("ascii", "replace").decode()
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.42, ink, 1, cv2.LINE_AA)
