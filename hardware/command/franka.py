"""`warp-deform franka`: the cable task on an arm, or on its twin.

    warp-deform franka run --robot sim --agent planner

Options are read here, and everything heavy is loaded by the verb that needs it.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import arg, subcommand

from warp_deform.command.main import Outcome
from warp_deform.errors import InputError
from warp_deform.quiet import quiet_warp
from warp_deform.support.flag_range import FlagRange

from ..rig.config import ChooserName
from .calibrate import CALIBRATE, CalibrateOptions
from .capture import CaptureGoalOptions, capture_goal
from .doctor import DoctorOptions, doctor
from .emulate import EmulateOptions, emulate
from .records import ReplayOptions, ScoreOptions, replay, score
from .rig_options import RigOptions, operator_page

if TYPE_CHECKING:
    from ..episodes.episode import EpisodeResult
    from ..episodes.goals import GoalMask
    from ..page.operator import PageOperator
    from ..rig.rig import Rig

__all__ = ["CollectOptions", "RunOptions", "franka"]

_DRY_ACTIONS = 1
"""Nothing moves in a dry run, so every further action would be planned on the same picture."""


@dataclass(frozen=True, kw_only=True)
class RunOptions(RigOptions):
    """Run one episode and record it.

    Nothing needs to be installed or prepared for `--robot sim`.
    """

    agent: ChooserName = "planner"
    """Who chooses the actions. planner simulates actions on the chain that the mask shows; policy
    acts as --policy was trained; scripted knows the simulated chain; random moves any point of the
    cable; with human you click, and with typed you type, where to pick and place."""
    policy: Annotated[Path | None, arg(metavar="RUN")] = None
    """Training run or snapshot of cable-mask-goal that --agent policy plays."""
    goal: Annotated[Path | None, arg(metavar="FILE.png")] = None
    """Mask to reach, as `capture-goal` writes it. With --camera sim the default is a curve that
    --seed draws."""
    max_actions: Annotated[int | None, arg(metavar="N"), FlagRange(1, 1000)] = None
    """Most actions of an episode. The default is 10, and 1 where nothing moves."""
    budget: Annotated[int | None, arg(metavar="N"), FlagRange(1, 10_000)] = None
    """Actions that the planner simulates for each one that it takes. The default is 32."""
    out: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the recording. The default is the next number in franka-episodes."""
    note: str = ""
    """A note of the operator, which is kept in the recording."""


@dataclass(frozen=True, kw_only=True)
class CollectOptions(RunOptions):
    """Record episodes one after another, and pack them as demonstrations.

    The packed episodes are a dataset for `warp-deform train cable-mask-goal`.
    """

    agent: ChooserName = "human"
    """Who chooses the actions, by the names that `run --agent` takes."""
    episodes: Annotated[int, arg(aliases=["-n"], metavar="N"), FlagRange(1, 100_000)] = 1
    """Episodes to record."""


_CALIBRATE = (
    "Measure the setup, in the order board, lens, table, camera, empty. points or hand can stand "
    "in for camera. docs/hardware.md explains each step."
)

_Options = (
    Annotated[DoctorOptions, subcommand("doctor")]
    | Annotated[CalibrateOptions, subcommand("calibrate", description=_CALIBRATE)]
    | Annotated[CaptureGoalOptions, subcommand("capture-goal")]
    | Annotated[CollectOptions, subcommand("collect")]
    | Annotated[RunOptions, subcommand("run")]
    | Annotated[ReplayOptions, subcommand("replay")]
    | Annotated[ScoreOptions, subcommand("score")]
    | Annotated[EmulateOptions, subcommand("emulate")]
)


def franka(options: _Options) -> Outcome:
    """The cable task on a Franka arm."""
    quiet_warp()
    return _VERBS[type(options)](options)


def _run(options: RunOptions) -> Outcome:
    from ..rig.rig import open_rig

    folder = options.out or _next_folder(Path("franka-episodes"))
    clock = time.monotonic()
    with operator_page(options, {"verb": "run", "agent": options.agent}) as page:
        with open_rig(options) as rig:
            result = _episode(options, rig, folder, page, seed=options.seed)
        data = {**_described(options, result), "seconds": time.monotonic() - clock}
        if page is not None:
            page.over(_text(data))
    return Outcome(data=data, text=_text(data), failure=_failure(result))


def _collect(options: CollectOptions) -> Outcome:
    from warp_deform.episodes import EpisodeWriter

    from ..recordings.pack import pack
    from ..rig.rig import open_rig
    from ..twin.camera import SimCamera

    if options.out is None:
        raise InputError("collect needs --out, the folder of the dataset")
    live, writer = options.out / "live", EpisodeWriter(options.out)
    done: list[EpisodeResult] = []
    demonstrations = 0
    with contextlib.ExitStack() as opened, contextlib.ExitStack() as stack:
        page = opened.enter_context(
            operator_page(options, {"verb": "collect", "agent": options.agent})
        )
        rig: Rig | None = None
        for number in range(options.episodes):
            seed = options.seed + number
            if rig is None or rig.toss is not None:
                # What is simulated is made anew, so that every episode is that of `run --seed`.
                stack.close()
                rig = stack.enter_context(open_rig(replace(options, seed=seed)))
            if isinstance(rig.camera, SimCamera):
                rig.camera.reseed(seed)
            if rig.toss is None:
                operator = options.operator(page, watched=True)
                if not operator.wait(f"episode {number + 1}: toss the cable"):
                    break
            done.append(_episode(options, rig, _next_folder(live), page, seed=seed))
            if done[-1].error is not None:
                break
            if not done[-1].outcomes:
                continue
            episode = pack(done[-1].folder, seed=int(done[-1].folder.name))
            if episode.info.success:
                writer.write(episode)
                demonstrations += 1
            else:
                _say(f"{done[-1].folder} is not kept as a demonstration: {_why_not(done[-1])}")
        data = {
            "out": options.out,
            "episodes": len(done),
            "demonstrations": demonstrations,
            "actions": sum(len(r.outcomes) for r in done),
            "recordings": [r.folder for r in done],
        }
        kept = f"{demonstrations} of them kept as demonstrations"
        text = f"{len(done)} episodes, {kept}, in {options.out}"
        if page is not None:
            page.over(text)
    return Outcome(data=data, text=text, failure=_failure(done[-1]) if done else None)


def _why_not(result: EpisodeResult) -> str:
    return "it begins where it ends" if result.score is None else "it did not reach its goal"


def _episode(
    options: RunOptions, rig: Rig, folder: Path, page: PageOperator | None, *, seed: int
) -> EpisodeResult:
    from warp_deform.support.revision import running_revision

    from ..choosers.human import click_pick_and_place
    from ..choosers.make import make_chooser
    from ..episodes.episode import EpisodeConfig, run_episode
    from ..episodes.goals import write_picture
    from ..recordings.recorder import EpisodeRecorder, RecorderConfig

    actions = options.max_actions
    if actions is None:
        actions = EpisodeConfig().max_actions if options.moves else _DRY_ACTIONS
    settings = EpisodeConfig(max_actions=actions, view=rig.view)
    goal = _goal(options, rig, seed)
    chooser = make_chooser(
        options.agent,
        rig,
        goal,
        seed=seed,
        policy=options.policy,
        budget=options.budget,
        show=click_pick_and_place if page is None else page.point,
    )

    def say(line: str) -> None:
        _say(line)
        if page is not None:
            page.say(line)

    if page is not None:
        page.begin(rig.calibration)
    described = RecorderConfig(
        robot_id=options.robot_id,
        camera_id=options.camera_id,
        actor=chooser.name,
        calibration=rig.calibration.digest(),
        config={
            "episode": settings.to_record(),
            "robot": options.robot,
            "camera": options.camera,
            "executed": options.moves,
            "seed": seed,
            "policy": None if options.policy is None else str(options.policy),
        },
        note=options.note,
        revision=running_revision().described,
    )
    mask = None if goal is None else goal.mask
    with EpisodeRecorder(folder, described, goal_mask=mask) as recorder:
        # with these and the pictures, `replay` makes the masks again
        rig.calibration.save(folder / "calibration.json")
        if rig.empty is not None:
            write_picture(folder / "empty_view.png", rig.empty)
        return run_episode(
            rig.robot,
            rig.camera,
            rig.calibration,
            chooser,
            recorder=recorder,
            goal=mask,
            config=settings,
            operator=options.operator(page, watched=options.real),
            empty=rig.empty,
            toss=rig.toss,
            say=say,
            show=None if page is None else page.look,
        )


def _goal(options: RunOptions, rig: Rig, seed: int) -> GoalMask | None:
    from ..episodes.goals import read_goal, sampled_goal

    if options.goal is not None:
        return read_goal(options.goal, rig.view)
    if options.camera == "sim":
        return sampled_goal(seed, rig.view)
    if isinstance(options, CollectOptions):
        return None
    raise InputError("run needs --goal; capture one with `warp-deform franka capture-goal`")


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _next_folder(parent: Path) -> Path:
    """The folder with the next free number."""
    return next(path for path in _numbered(parent) if not path.exists())


def _numbered(parent: Path) -> Iterator[Path]:
    for number in range(10**6):
        yield parent / f"{number:04d}"


def _described(options: RunOptions, result: EpisodeResult) -> dict[str, Any]:
    score = result.score
    return {
        "folder": result.folder,
        "robot": options.robot,
        "camera": options.camera,
        "agent": options.agent,
        "executed": options.moves,
        "outcome": result.outcome,
        "success": score is not None and score.success,
        "actions": len(result.outcomes),
        "outcomes": [str(outcome) for outcome in result.outcomes],
        "iou": [] if score is None else list(score.iou),
        "actions_to_success": None if score is None else score.actions_to_success,
    }


def _text(data: dict[str, Any]) -> str:
    overlaps = " ".join(f"{value:.3f}" for value in data["iou"]) or "no goal"
    moved = "" if data["executed"] else " (nothing moved: --robot sim, or --execute, moves)"
    return (
        f"{data['outcome']} after {data['actions']} actions{moved}; overlap {overlaps}\n"
        f"recorded in {data['folder']}"
    )


def _failure(result: EpisodeResult) -> str | None:
    return None if result.error is None else result.outcome.removeprefix("error: ")


_VERBS: dict[type, Callable[[Any], Outcome]] = {
    DoctorOptions: doctor,
    **CALIBRATE,
    CaptureGoalOptions: capture_goal,
    CollectOptions: _collect,
    RunOptions: _run,
    ReplayOptions: replay,
    ScoreOptions: score,
    EmulateOptions: emulate,
}
"""By its options, what a verb does."""
