"""Evaluated runs, found in folders, and which variant of training and playing each is."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from warp_deform.episodes.corrected import is_corrected
from warp_deform.errors import InputError

from ..policy.policy import AGENTS
from ..runs.folder import RunFolder
from ..training.schedules import SCHEDULES, preset_schedule
from .cells import RunResult, check_run

__all__ = ["read_runs"]


def read_runs(paths: Sequence[Path]) -> tuple[list[RunResult], list[str]]:
    """Evaluated runs of folders, each a run or holding runs at any depth; and notes on the others.

    Raises:
        InputError: a folder is missing or holds no run, none is evaluated, or a file is damaged.
    """
    folders: dict[Path, Path] = {}
    for path in paths:
        runs_of_path = [path] if (path / "run.json").is_file() else sorted(_inside(path))
        if not runs_of_path:
            raise InputError(
                f"{path} holds no training run; `warp-deform train` makes one with --out"
            )
        folders |= {each.resolve(): each for each in runs_of_path}
    runs, notes = [], []
    for folder in folders.values():
        run = RunFolder(folder)
        if run.report.is_file():
            info = run.read_report()
            notes += _other_seeds(folder, info)
            if info["test"] is not None:
                runs.append(_read(run))
                continue
        if not run.report.is_file() or info["test"] is None:
            notes.append(f"{folder} is not evaluated and left out; run `warp-deform eval {folder}`")
    if not runs:
        raise InputError(f"no run is evaluated yet; run `warp-deform eval {next(iter(folders))}`")
    return runs, notes


def _other_seeds(folder: Path, info: Mapping[str, Any]) -> list[str]:
    """A line for every set of other seeds that a run played."""
    return [
        f"{folder} also played seeds {other['first_seed']} and up: {other['test']['n_success']} of "
        f"{other['test']['n_episodes']} solved, mean score {other['test']['mean_score']:.3f}; "
        "tables and curves leave them out"
        for other in info.get("other_seeds", {}).values()
    ]


def _inside(path: Path) -> Iterable[Path]:
    if not path.is_dir():
        raise InputError(f"there is no folder {path}")
    return (settings.parent for settings in path.rglob("run.json"))


def _read(run: RunFolder) -> RunResult:
    info, settings = run.read_report(), run.read_settings()
    try:
        result = RunResult(
            path=run.path,
            task=info["task"],
            agent=info["agent"],
            demos=info["demos"],
            seed=info["seed"],
            variant=_variant(info, settings),
            info=info,
            settings=settings,
        )
        check_run(result)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        raise InputError(
            f"{run.report} is not what this release's `warp-deform eval` writes; evaluate again"
        ) from error
    return result


def _variant(info: Mapping[str, Any], settings: Mapping[str, Any]) -> str:
    """How a run was trained and played, but for task, agent, demonstrations and seed."""
    parts = [info["preset"], *_steps(info, settings)]
    if info["stage_rule"] != "action":
        parts.append(f"{info['stage_rule']} lift")
    if not info["retry"]:
        parts.append("no retries")
    if info["goals"] != "constructed":
        parts.append(f"goals {info['goals']}")
    if info["robot"] != "ur5":
        parts.append(info["robot"])
    names = [name for name in settings["demonstrators"] if not is_corrected(name)]
    if names and names != ["scripted"]:
        parts.append(f"{' and '.join(names)} demonstrations")
    if settings.get("corrected"):
        by = [name for name in settings["demonstrators"] if is_corrected(name)]
        parts.append(f"{settings['corrected']} episodes {' and '.join(by)}")
    if settings.get("goal") == "own":
        parts.append("goals of their own")
    if given := settings.get("given_goals"):
        all_of_them = given == len(settings["demonstrations"])
        parts.append("goals given" if all_of_them else f"goals given to {given} of them")
    if settings.get("start"):
        parts.append("begun with trained weights")
    return ", ".join(parts)


def _steps(info: Mapping[str, Any], settings: Mapping[str, Any]) -> list[str]:
    """How long a run was trained, where that is not its preset's length.

    Where validation may stop it, as long as that allowed.
    """
    planned, trained = int(settings["schedule"]["steps"]), int(info["trained_steps"])
    if settings.get("patience") is not None:
        return [f"up to {planned} steps, patience {settings['patience']}"]
    if settings.get("validate"):
        return [f"up to {planned} steps"]
    if trained != planned:
        return [f"{trained} of {planned} steps"]
    usual = None
    if info["preset"] in SCHEDULES and info["agent"] in AGENTS:
        usual = preset_schedule(
            info["preset"],
            task=info["task"],
            demos=info["demos"],
            sees=AGENTS[info["agent"]].sees,
        )
    return [] if usual is not None and planned == usual.steps else [f"{planned} steps"]
