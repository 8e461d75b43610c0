"""The verbs that open a page in the browser: `warp-deform play` and `warp-deform view`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from warp_deform.command.main import Outcome
from warp_deform.command.page_options import PageOptions
from warp_deform.errors import InputError
from warp_deform.quiet import quiet_warp
from warp_deform.robots import RobotName
from warp_deform.support.flag_range import SEED
from warp_deform.tasks.registry import task as find_task

__all__ = ["PlayOptions", "ViewOptions", "play", "view"]


@dataclass(frozen=True, kw_only=True)
class PlayOptions(PageOptions):
    """Pick and place by mouse, in a page in the browser."""

    task: Annotated[Positional[str], arg(metavar="TASK")]
    """Name of the task; `warp-deform list` shows all of them."""
    policy: Annotated[tuple[Path, ...], arg(metavar="RUN")] = ()
    """Training runs, or snapshots: policies that may act in your place and show where they look."""
    record: Annotated[Path | None, arg(metavar="DIR")] = None
    """Folder for the episodes that are kept at the page; a later session goes on in it."""
    seed: Annotated[int | None, SEED] = None
    """Seed of the first episode; by default the first, from 0 on, of which none is kept."""
    robot: RobotName = "ur5"
    """Which arm moves."""


def play(options: PlayOptions) -> Outcome:
    """Serve the page until Ctrl-C."""
    find_task(options.task)
    from warp_deform.page.play import PlaySession
    from warp_deform.page.server import check_websockets, listen, serve_until_interrupted

    from ..page.policy_player import PolicyPlayer

    check_websockets()
    opener, bound = options.opener(), listen(options.port)
    with bound:
        quiet_warp()
        players: list[PolicyPlayer] = []
        for path in options.policy:
            player = PolicyPlayer(path, task=options.task)
            taken = [each.name for each in players]
            if player.name in taken:
                player.name = f"{player.name} {taken.count(player.name) + 1} ({path.name})"
            players.append(player)
        session = PlaySession(
            options.task,
            robot=options.robot,
            seed=options.seed,
            record=options.record,
            players=players,
        )
        serve_until_interrupted(session, bound, browser=opener)
    kept = session.kept.count if session.kept else 0
    where = f"; {options.record} holds {kept} demonstrations" if options.record else ""
    return Outcome(
        data={"task": options.task, "episodes": kept}, text=f"played {options.task}{where}"
    )


@dataclass(frozen=True, kw_only=True)
class ViewOptions(PageOptions):
    """Watch recorded episodes in a page in the browser, and compare two."""

    folder: Annotated[Positional[Path], arg(metavar="DIR")]
    """Folder of episodes: of demonstrations, of a session of `play`, or of packed recordings of a
    robot. Or the folder of a training run that was evaluated."""


def view(options: ViewOptions) -> Outcome:
    """Serve the page until Ctrl-C."""
    if not options.folder.is_dir():
        raise InputError(f"no folder {str(options.folder)!r}; `warp-deform demo` makes one")
    from warp_deform.page.server import check_websockets, listen, serve_until_interrupted
    from warp_deform.page.sources import EpisodeSource, Source
    from warp_deform.page.view import ViewSession

    from ..page.evaluations import EvaluationSource
    from ..page.kinds import kind_of

    check_websockets()
    opener, bound = options.opener(), listen(options.port)
    with bound:
        quiet_warp()
        source: Source
        if (options.folder / "run.json").exists():
            source = EvaluationSource(options.folder)
        else:
            source = EpisodeSource(options.folder, kind=kind_of)
        session = ViewSession(source)
        serve_until_interrupted(session, bound, browser=opener)
    count = len(session.entries)
    data = {"folder": options.folder, "episodes": count}
    return Outcome(data=data, text=f"{options.folder}: {count} episode{'s' * (count != 1)}")
