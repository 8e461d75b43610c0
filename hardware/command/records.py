"""The verbs of `warp-deform franka` that read recorded episodes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import InputError

__all__ = ["ReplayOptions", "ScoreOptions", "replay", "score"]

_Folders = Annotated[Positional[tuple[Path, ...]], arg(metavar="EPISODE")]


@dataclass(frozen=True, kw_only=True)
class ScoreOptions(CommandOptions):
    """Compute the scores of recorded episodes anew, from their masks."""

    episodes: _Folders
    """Folders that `run` or `collect` recorded; interrupted ones are accepted."""


def score(options: ScoreOptions) -> Outcome:
    """Score episodes."""
    from ..recordings.scoring import score_recording

    if not options.episodes:
        raise InputError("no episode is named; name folders that `franka run` recorded")
    rows: list[dict[str, Any]] = []
    lines = []
    failed: list[dict[str, Any]] = []
    for folder in options.episodes:
        try:
            result = score_recording(folder)
        except InputError as error:
            failed.append({"folder": folder, "error": str(error)})
            lines.append(f"{folder}  not scored: {error}")
            continue
        rows.append(
            {
                "folder": folder,
                "success": result.success,
                "actions": len(result.iou) - 1,
                "actions_to_success": result.actions_to_success,
                "iou": list(result.iou),
                "at_start": result.at_start,
                "best": result.best[-1],
                "warnings": list(result.warnings),
                "differences": list(result.differences),
            }
        )
        verdict = f"success after {result.actions_to_success}" if result.success else "no success"
        lines.append(f"{folder}  {verdict}, best overlap {result.best[-1]:.3f}")
        lines += [f"  {line}" for line in (*result.warnings, *result.differences)]
    counted = [row for row in rows if not row["at_start"]]
    won = [row["actions_to_success"] for row in counted if row["success"]]
    mean = sum(won) / len(won) if won else None
    data = {
        "episodes": rows,
        "n_episodes": len(counted),
        "n_success": len(won),
        "n_at_start": len(rows) - len(counted),
        "failed": failed,
        "mean_actions_solved": mean,
    }
    after = "" if mean is None else f", after {mean:.1f} actions on average"
    lines.append(f"{len(won)} of {len(counted)} episodes succeeded{after}")
    if len(counted) < len(rows):
        lines.append(f"{len(rows) - len(counted)} more began at their goal, and are not counted")
    failure, code = None, 1
    differ = [row for row in rows if row["differences"]]
    if failed:
        count = f"{len(failed)} of {len(options.episodes)} folders cannot be scored"
        failure, code = f"{count}; {failed[0]['error']}", 2
    elif differ:
        count = f"{len(differ)} of {len(options.episodes)} recordings differ from their pictures"
        failure = f"{count}; {differ[0]['folder']}: {differ[0]['differences'][0]}"
    return Outcome(data=data, text="\n".join(lines), failure=failure, failure_code=code)


@dataclass(frozen=True, kw_only=True)
class ReplayOptions(CommandOptions):
    """Compute masks and overlaps of an episode again from its pictures, and compare them."""

    episode: Annotated[Positional[Path], arg(metavar="EPISODE")]
    """Folder that `run` or `collect` recorded; an interrupted one is accepted."""
    video: Annotated[Path | None, arg(metavar="FILE.mp4")] = None
    """Also write a film of the plans, with two pictures a second."""


def replay(options: ReplayOptions) -> Outcome:
    """Replay an episode."""
    from ..recordings.replay import replay_recording, write_film

    comparison = replay_recording(options.episode)
    if options.video is not None:
        write_film(options.episode, options.video)
    lines = []
    for row in comparison.rows:
        overlap = "" if row["iou"] is None else f"overlap {row['iou']:.3f}"
        lines.append(f"{row['index']:>3}  {overlap}  {row['outcome'] or ''}".rstrip())
    lines += [f"  {line}" for line in (*comparison.warnings, *comparison.differences)]
    masks = f"{comparison.mismatches} of {len(comparison.rows)} masks differ"
    lines.append(f"outcome: {comparison.outcome}; {masks}")
    data = {
        "folder": options.episode,
        "outcome": comparison.outcome,
        "observations": len(comparison.rows),
        "actions": comparison.actions,
        "mismatches": comparison.mismatches,
        "rows": comparison.rows,
        "warnings": list(comparison.warnings),
        "differences": list(comparison.differences),
        "video": options.video,
    }
    failure = None
    if comparison.differences:
        more = len(comparison.differences) - 1
        others = f", and {more} more" if more else ""
        failure = (
            f"what is recorded and what is computed differ: {comparison.differences[0]}{others}"
        )
    return Outcome(data=data, text="\n".join(lines), failure=failure)
