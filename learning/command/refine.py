"""The verb `refine` of the `warp-deform` command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Literal, get_args

from tyro.conf import arg

from warp_deform.command.main import CommandOptions, Outcome
from warp_deform.errors import InputError
from warp_deform.quiet import quiet_warp
from warp_deform.support.flag_range import COUNT

from ..refinement.settings import FolderSettings, RefineSettings

__all__ = ["RefineOptions", "refine"]

_OfActions = Literal["enumerate", "random", "cem", "gradient"]


@dataclass(frozen=True, kw_only=True)
class RefineOptions(RefineSettings, CommandOptions):
    """Improve recorded demonstrations by search; the same command goes on where it was stopped."""

    method: Literal[
        "enumerate", "random", "cem", "gradient", "cmaes", "adam", "lbfgs", "cem+adam"
    ] = "cem"
    """How to search beyond the task's candidates: not at all, by random draws, by draws ever closer
    to the best (the cross-entropy method), or down the gradient of the task's loss. With
    --trajectories: random, cem, cmaes, adam, lbfgs or cem+adam."""
    depth: Literal[1, 2] = 2
    """Actions to look ahead."""
    budget: Annotated[int, arg(metavar="N"), COUNT] = 64
    """Simulated actions that the search for one action may spend."""
    lifts: bool = False
    """Let the search move the lift of an action too; policies lift as the task does."""
    waypoints: bool = False
    """Bend the paths of the recorded actions instead, by the gradient. No policy can follow such
    paths, so the folder then holds paths and no demonstrations."""
    trajectories: bool = False
    """Refine demonstrations at 20 Hz (see `demo --control`) as trajectories: shorter, more exact,
    smoother. Picks and places are led at 20 Hz first."""
    evaluations: Annotated[int, arg(metavar="N"), COUNT] = 250
    """With --trajectories: simulated episodes that the search for one may spend."""
    horizon: Annotated[int | None, arg(metavar="N"), COUNT] = None
    """With --trajectories: control steps after which a replay of picks and places at 20 Hz is given
    up. By default the environment's, 200 for tasks of the benchmark."""
    video: Annotated[Path | None, arg(metavar="FILE")] = None
    """With --trajectories: film two refined episodes beside their originals into this MP4."""


def refine(options: RefineOptions) -> Outcome:
    """Refine a folder of demonstrations."""
    from warp_deform.planning import SearchConfig

    from ..refinement.refine import RefineConfig
    from ..refinement.refine import refine as refine_folder

    quiet_warp()
    if options.trajectories:
        return _trajectories(options)
    _refuse(options, ("evaluations", "horizon", "video"), "goes with --trajectories")
    if options.method not in get_args(_OfActions):
        raise InputError(f"--method {options.method} goes with --trajectories")
    if options.waypoints:
        return _bend(options)
    config = options.configure(RefineConfig, search=options.configure(SearchConfig))
    report = refine_folder(config)
    text = (
        f"{options.out}: {report.improved} of {report.episodes} episodes improved, actions "
        f"{report.actions_before} -> {report.actions_after}, mean score {report.score_before:.3f} "
        f"-> {report.score_after:.3f}, in {report.seconds:.1f} s"
    )
    if report.origins:
        text += "; actions of the improved: "
        text += ", ".join(f"{count} {name}" for name, count in report.origins.items())
    return Outcome(data=asdict(report), text=text)


def _refuse(options: RefineOptions, names: Sequence[str], why: str) -> None:
    """Raise InputError where one of these flags is not as usual."""
    usual = {field.name: field.default for field in fields(options)}
    for name in names:
        if getattr(options, name) != usual[name]:
            raise InputError(f"--{name.replace('_', '-')} {why}")


def _trajectories(options: RefineOptions) -> Outcome:
    """Refine demonstrations at 20 Hz."""
    from ..refinement.film import check_filmed, film_refined
    from ..refinement.trajectories import TrajectoryConfig, refine_trajectories

    others = ("accept", "depth", "budget", "lifts", "waypoints")
    _refuse(options, others, "does not go with --trajectories")
    if options.method in ("enumerate", "gradient"):
        raise InputError(f"--method {options.method} does not go with --trajectories")
    if options.video is not None:
        check_filmed(options.source, options.video)
    report = refine_trajectories(options.configure(TrajectoryConfig))
    if options.video is not None:
        film_refined(options.source, options.out, options.video)
    count = report.episodes
    text = (
        f"{options.out}: {report.improved} of {count} episodes improved; control steps "
        f"{report.actions_before} -> {report.actions_after}, mean loss {report.loss_before:.4f} -> "
        f"{report.loss_after:.4f}, mean roughness {report.roughness_before:.2f} -> "
        f"{report.roughness_after:.2f}, not solved at rest {report.unrested_before} -> "
        f"{report.unrested_after}, in {report.seconds:.1f} s"
    )
    if report.kept:
        text += "; kept: " + ", ".join(f"{n} {why}" for why, n in report.kept.items())
    if report.lost:
        text += f"; left out, because at 20 Hz they do not solve the task: {report.lost}"
    return Outcome(data=asdict(report), text=text)


def _bend(options: RefineOptions) -> Outcome:
    """Bend the paths of a folder's actions."""
    from warp_deform.planning.action_search import GRADIENT_COST
    from warp_deform.planning.waypoints import WaypointConfig

    from ..refinement.waypoints import BendConfig, bend

    applies = {field.name for kind in (FolderSettings, CommandOptions) for field in fields(kind)}
    given = {name: getattr(options, name) for name in (*applies, "budget", "waypoints")}
    if options != RefineOptions(**given):
        raise InputError("of the search's flags --waypoints takes only --budget and --workers")
    steps = options.budget // (GRADIENT_COST + 1)
    if steps < 1:
        raise InputError(
            f"a step of waypoints costs {GRADIENT_COST + 1} simulated actions; "
            "give --budget that or more"
        )
    config = options.configure(BendConfig, bending=WaypointConfig(steps=steps))
    report = bend(config)
    text = (
        f"{options.out}: {report.bent} of {report.actions} paths bent (no demonstrations), in "
        f"{report.seconds:.1f} s"
    )
    if report.actions:
        text += (
            f"; mean loss after an action {report.loss_before:.4f} -> {report.loss_after:.4f}, "
            f"mean score {report.score_before:.3f} -> {report.score_after:.3f}"
        )
    return Outcome(data=asdict(report), text=text)
