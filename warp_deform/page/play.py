"""The session of `warp-deform play`: one task, acted on by whoever is at the page."""

from __future__ import annotations

import copy
import threading
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from ..collecting.recording import observe
from ..episodes import Step
from ..errors import InputError, WarpDeformError
from ..rendering.pixels import BOUNDS
from ..robots.primitive import Outcome, find_grasp
from ..support.flag_range import SEED
from ..tasks.metrics import wrap_angle
from ..tasks.task import Action
from ..worlds.episode import DEMONSTRATOR_STREAM, StepReport, episode_rng
from ..worlds.loop import EpisodeRun
from ..worlds.spaces import check_action
from ..worlds.state import WorldState
from ..worlds.worlds import Worlds
from .access import StaticFile
from .contest import Contest, Standing
from .drawing import FRAMES_A_SECOND, arm_arrays, clip, grid_head, link_matrices
from .fault import Fault, where_it_broke
from .guidance import at_work, has_gradients, play_alone, pull_of_place, sight_message
from .keeping import HUMAN, KeptEpisodes
from .measures import score_meaning
from .players import Player, demonstrators
from .server import Post
from .telling import scene_arrays, state_head, state_pictures, why_over
from .wire import Job, Verbs, pack

__all__ = ["PlaySession"]


class PlaySession:
    """One running episode, its past, and where it is kept; see `server.Session`.

    Args:
        seed: of the first episode; None: the first from 0 on of which none is kept
        record: folder for what is kept
        players: who may act beside the person and the demonstrators

    Attributes:
        run: what is recorded of the running episode
        acted: who chose each of its actions
    """

    files: Mapping[str, StaticFile] = {"": StaticFile("index.html")}
    verbs: Verbs = {
        "act": {"pick": list, "place": list, "turn": float, "lift": float},
        "probe": {"xy": list, "turn": float},
        "demonstrate": {"who": str, "whole": bool},
        "look": {"who": str},
        "versus": {"who": str},
        "gradient": {"pick": list, "place": list, "turn": float, "lift": float},
        "undo": {},
        "reset": {"seed": int},
        "next": {},
        "keep": {},
    }
    urgent: frozenset[str] = frozenset()

    def __init__(
        self,
        task: str,
        *,
        robot: str = "ur5",
        seed: int | None = None,
        record: Path | None = None,
        players: Sequence[Player] = (),
    ) -> None:
        self.stop = threading.Event()
        self.worlds = Worlds(task, 1, robot=robot)
        self.kept = KeptEpisodes(record, self.worlds.task.name) if record else None
        self.players = demonstrators(players)
        self.contest = Contest()
        self._version = 0
        self._fault: Fault | None = None
        self._arm, self._parts = arm_arrays(self.worlds.robot)
        link_matrices(
            self.worlds.robot, self.worlds.robot.home_q[None]
        )  # loads torch before anybody waits for it
        self.reset(self._free(0) if seed is None else seed)

    # What the episode is

    def _free(self, first: int) -> int:
        return self.kept.free_seed(first) if self.kept else first

    def reset(self, seed: int) -> None:
        """Start the episode of a seed.

        Raises:
            WarpDeformError: it has no valid start; the episode before goes on.
        """
        if not SEED.low <= seed <= SEED.high:
            raise InputError(f"a seed is {SEED.low:.10g} to {SEED.high:.10g}, not {str(seed)[:20]}")
        before = self.worlds.state(0) if self.worlds.episodes else None
        try:
            self.worlds.reset({0: seed})
        except WarpDeformError:
            if before is not None:
                self.worlds.restore(0, before)
            raise
        self.start = self.worlds.state(0)
        self.run: EpisodeRun[Step] = EpisodeRun(seed, episode_rng(seed, DEMONSTRATOR_STREAM))
        self.run.rows.append(observe(self.worlds, 0))
        self.past: list[WorldState] = []
        self.acted: list[str] = []
        for player in self.players.values():
            player.begin()
        self._version += 1

    @property
    def broken(self) -> bool:
        """Whether a guard has fired, so that the state cannot be trusted."""
        return not self.worlds.episodes[0].physics_ok

    @property
    def over(self) -> str:
        """Why nothing more is to be done, empty while something is."""
        return why_over(self.worlds)

    def head(self) -> dict[str, Any]:
        """What the page tells of the present state, as JSON."""
        return {
            **state_head(self.worlds, self._fault),
            "version": self._version,
            "actions": len(self.run.actions),
            "outcomes": list(self.run.outcomes),
            "acted": list(self.acted),
            "kept": self.kept.count if self.kept else 0,
        }

    # What the page is told

    def greet(self) -> list[bytes]:
        """See `Session.greet`."""
        worlds, task = self.worlds, self.worlds.task
        about = {
            "task": task.name,
            "meaning": score_meaning(task),
            "robot": worlds.robot.name,
            "instruction": task.instruction,
            "goal": task.goal_conditioned,
            "gradients": has_gradients(task),
            "lifts": [stage.lift for stage in task.stages],
            "jaw": task.jaw is not None,
            "grid": grid_head(task.grid),
            "bounds": BOUNDS[:2],
            "frames": FRAMES_A_SECOND,
            "parts": self._parts,
            "players": [{"name": p.name, "looks": p.looks} for p in self.players.values()],
            "records": self.kept is not None,
        }
        return [pack("hello", self._arm, **about), self.scene(), self._table()]

    def scene(self) -> bytes:
        """The message that shows the present state whole."""
        last = self.past[-1].episode.snapshot if self.past else None
        arrays = {**scene_arrays(self.worlds, last), **state_pictures(self.worlds)}
        return pack("scene", arrays, **self.head())

    # What it does

    def do(self, job: Job, post: Post) -> None:
        """See `Session.do`."""
        if job.do == "probe":
            post(self._probe(job), everyone=False)
            return
        if job.at not in (-1, self._version):
            raise InputError("another tab was quicker; look at what is there now")
        getattr(self, f"_do_{job.do}")(job, post)

    def _probe(self, job: Job) -> bytes:
        """What the tip would take where the pointer is."""
        worlds, snapshot = self.worlds, self.worlds.episodes[0].snapshot
        at = np.array([*job.numbers("xy", 2), job.number("turn")])
        grasp = None
        if worlds.episodes[0].physics_ok and worlds.task.jaw is None:
            q, body = snapshot.particle_q, snapshot.body_q
            grasp = find_grasp(at, snapshot.objects, q, body, worlds.task.primitive)
        particle = -1 if grasp is None or grasp.particle is None else grasp.particle
        taken_body = -1 if grasp is None or grasp.body is None else grasp.body
        return pack("grasp", version=self._version, particle=particle, body=taken_body)

    def action(self, job: Job) -> Action:
        """The action (7,) that a page's pick, place, turn and lift stand for.

        The pick's yaw is the task's, as for policies; the place's is turned from it.

        Raises:
            InputError: it is outside of the action space.
        """
        task, episode = self.worlds.task, self.worlds.episodes[0]
        pick, place = job.numbers("pick", 2), job.numbers("place", 2)
        turn, lift = job.number("turn"), job.number("lift")
        checked = check_action([*pick, 0.0, *place, wrap_angle(turn), lift])
        yaw = float(task.pick_yaw(episode.snapshot.images.color, checked[:2]))
        if yaw != 0.0:
            checked[2], checked[5] = yaw, wrap_angle(yaw + turn)
        return checked

    def _refuse_when_over(self) -> None:
        if self.over:
            raise InputError(f"the episode is over ({self.over}): undo, or start another")

    def _do_act(self, job: Job, post: Post) -> None:
        self._refuse_when_over()
        post(self.step(self.action(job), HUMAN, post))
        self._note_standing(post)

    def step(self, action: Action, who: str, post: Post) -> bytes:
        """Carry out an action and return the message that shows it.

        The approach is posted before the carry is computed, so that a page need not wait for it.

        Raises:
            InputError: a person asked for what the arm cannot reach; nothing has changed.
        """
        worlds, episode = self.worlds, self.worlds.episodes[0]
        before, waiting = worlds.state(0), episode.posture.copy()

        def lead(reports: Mapping[int, StepReport]) -> None:
            approach = clip(worlds.robot, reports[0], waiting, worlds.episodes[0].snapshot)
            if approach is not None:
                told = {"seed": self.run.seed, "actions": len(self.run.actions) + 1}
                post(pack("lead", approach[0], end=approach[1], **told))

        report = worlds.step({0: action}, record=1.0 / FRAMES_A_SECOND, on_carry=lead)[0]
        if report.outcome is Outcome.UNREACHABLE and who == HUMAN:
            worlds.restore(0, before)
            raise InputError("the arm cannot reach there with its tip down; nothing has moved")
        self.past.append(before)
        self._fault = None
        self.run.actions.append(np.array(action, dtype=float))
        self.run.outcomes.append(report.outcome.value)
        self.acted.append(who)
        if worlds.episodes[0].physics_ok:
            self.run.rows.append(observe(worlds, 0))
        self._version += 1
        moved = clip(worlds.robot, report, waiting, worlds.episodes[0].snapshot)
        if moved is None:
            return self.scene()
        arrays, seconds = moved
        if self.broken:
            drawables = worlds.episodes[0].drawables
            self._fault = where_it_broke(drawables, arrays["q"], 1.0 / FRAMES_A_SECOND)
        return pack(
            "clip",
            {**arrays, **state_pictures(worlds)},
            **self.head(),
            end=seconds,
            action=[float(each) for each in action],
        )

    def _player(self, job: Job) -> Player:
        player = self.players.get(job.values["who"])
        if player is None:
            raise InputError(f"there is nobody called {job.values['who'][:40]!r}")
        return player

    def _do_demonstrate(self, job: Job, post: Post) -> None:
        player = self._player(job)
        self._refuse_when_over()
        while not self.over and not self.stop.is_set():
            with at_work(player.name, post):
                action = self._choice(player, self.run)
                post(sight_message(player, self.worlds, action, acts=True))
                post(self.step(action, player.name, post))
            self._note_standing(post)
            if not job.values["whole"]:
                return

    def _choice(self, player: Player, run: EpisodeRun[Step]) -> Action:
        action = player.choose(self.worlds, run)
        if action is None:
            raise InputError(f"{player.name} sees nothing to do")
        return check_action(action, name=player.name)

    def _do_look(self, job: Job, post: Post) -> None:
        """Show what somebody would do, and where it looks; nothing is done or drawn for it."""
        player = self._player(job)
        self._refuse_when_over()
        with at_work(player.name, post):
            action = self._choice(
                player.aside(), replace(self.run, rng=copy.deepcopy(self.run.rng))
            )
            post(sight_message(player, self.worlds, action))

    def _do_versus(self, job: Job, post: Post) -> None:
        """Let somebody play the episode from its start; the person's goes on where it was."""
        player = self._player(job)
        worlds, now = self.worlds, self.worlds.state(0)
        worlds.restore(0, self.start)
        with at_work(player.name, post):
            try:
                standing = play_alone(player, worlds, self.run.seed, self.stop)
            finally:
                worlds.restore(0, now)
                player.begin()
        if standing is None:
            raise InputError(f"{player.name} was stopped before it came to an end")
        self.contest.note(self.run.seed, player.name, standing)
        post(self._table())

    def _do_gradient(self, job: Job, post: Post) -> None:
        """Show where the adjoint says that the place of an action should move."""
        self._refuse_when_over()
        action = self.action(job)
        with at_work("the adjoint", post):
            pull = pull_of_place(self.worlds, action)
        post(pack("gradient", place=[float(each) for each in action[3:5]], **pull))

    def _note_standing(self, post: Post) -> None:
        """Keep how the person's own episode stands, once it is over."""
        if self.over and not self.broken and set(self.acted) == {HUMAN}:
            score, solved = float(self.worlds.score(0)), self.worlds.solved(0)
            standing = Standing(score, len(self.run.actions), solved)
            self.contest.note(self.run.seed, "you", standing)
            post(self._table())

    def _table(self) -> bytes:
        return pack("table", rows=self.contest.rows())

    def _do_undo(self, job: Job, post: Post) -> None:
        if not self.past:
            raise InputError("there is nothing to undo")
        self.worlds.restore(0, self.past.pop())
        for taken_back in (self.run.actions, self.run.outcomes, self.acted):
            taken_back.pop()
        del self.run.rows[len(self.run.actions) + 1 :]
        for player in self.players.values():
            player.begin()
        self._version += 1
        post(self.scene())

    def _do_reset(self, job: Job, post: Post) -> None:
        self.reset(job.values["seed"])
        post(self.scene())

    def _do_next(self, job: Job, post: Post) -> None:
        self.reset(self._free(self.run.seed + 1))
        post(self.scene())

    def _do_keep(self, job: Job, post: Post) -> None:
        if self.kept is None:
            raise InputError("nothing is recorded; start it with --record DIR")
        path = self.kept.keep(self.worlds, self.run, self.acted)
        self.reset(self._free(self.run.seed + 1))
        post(self.scene())
        post(pack("note", text=f"kept as {path.parent.name}/{path.name}", good=True))
