"""Random access to demonstrations with little memory: a cache of plain rows that is memory-mapped.

An episode's file holds compressed pictures; what training reads again and again is a derived cache,
`rows/` in the dataset's folder, one NumPy file per episode, named after the contents of the episode
it was made from. It may be deleted at any time, and several processes may make it at once.
"""

from __future__ import annotations

import copy
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from warp_deform.episodes import Episode, EpisodeReader, Step, episode_name, read_index
from warp_deform.episodes.corrected import is_corrected, labels_of
from warp_deform.errors import InputError
from warp_deform.support.whole_file import whole_file
from warp_deform.tasks.registry import task as find_task
from warp_deform.tasks.task import Task

from .goal_name import GoalName
from .goals import given_goals, making_goals, refuse_own_goal, refuse_test_goal

__all__ = [
    "Demonstrations",
    "LearntGoal",
    "Transition",
    "check_learnt_goals",
    "choose",
    "remove_cache",
]

LearntGoal = GoalName | Literal["played"]
"""What is learnt with; "played": what was done, and where it led."""
_FOLDER = "rows"
_FORMAT = 1
_COLUMNS = "color", "height", "action", "ground_truth"
_IMPORTED = "original"
"""Whose the recordings of the original code are, `interchange.original_recording.DEMONSTRATOR`."""
_IMPORTED_ABOVE = {"bag-color-goal": 0.5}
"""Scores that the original code's recordings of a task must exceed to be kept."""
_IMPORTED_SOLVED = "bag-items-1", "bag-items-2"
"""Tasks of whose recordings by the original code it keeps the solved ones."""


class Transition(NamedTuple):
    """One demonstrated action: what was seen, what was done, and with which goal.

    Attributes:
        color: before the action (H, W, 3) uint8
        height: before the action (H, W) float32 [m]
        goal_color: of the goal (H, W, 3) uint8, see `Demonstrations`
        goal_height: the same as heights (H, W) float32 [m]
        action: what is to be learnt (7,) float64 pick x, y, yaw, place x, y, yaw, lift [m, rad]
    """

    color: np.ndarray
    height: np.ndarray
    goal_color: np.ndarray
    goal_height: np.ndarray
    action: np.ndarray


def choose(seeds: tuple[int, ...], count: int, *, seed: int) -> tuple[int, ...]:
    """The `count` episodes that training run `seed` learns from, drawn without replacement.

    Source: Seita et al., ICRA 2021, section on training (1, 10, 100 of 1000, drawn by run).

    Examples:
        >>> choose((3, 5, 8, 13), 2, seed=0)
        (8, 13)

    Raises:
        InputError: there are not so many.
    """
    if not 1 <= count <= len(seeds):
        raise InputError(
            f"--demos is {count}; the data holds {len(seeds)} demonstrations, so ask for 1 to "
            f"{len(seeds)} or collect more"
        )
    chosen = np.random.default_rng(seed).choice(np.array(seeds), count, replace=False)
    return tuple(sorted(chosen.tolist()))


def check_learnt_goals(
    reader: EpisodeReader, seeds: Iterable[int], task: Task, *, goal: LearntGoal
) -> None:
    """Refuse episodes of these seeds that went for a goal that no agent should learn from.

    Args:
        goal: what counts as the goal of demonstrations; of corrected episodes it is their own

    Raises:
        InputError: a goal is one of tests, or is learnt though it shows what theirs do not.
    """
    for seed in seeds if task.goal_conditioned else ():
        info, what = reader.info(seed), reader.path(seed)
        if info.goal is None:
            continue
        corrected = is_corrected(info.demonstrator)
        verb = "correct" if corrected else "demo"
        advice = f"collect for goals of other seeds (`{making_goals(task)}`, then `{verb} --goals`)"
        refuse_test_goal(int(info.goal["seed"]), what=what, advice=advice)
        if goal == "own" and not corrected:
            refuse_own_goal(info, task, what=what, advice=f"{advice}, or leave --goal out")
        elif goal != "played" and corrected:
            refuse_own_goal(info, task, what=what, advice=advice)


def remove_cache(folder: Path) -> None:
    """Remove what training read of a folder; it is made again when it is needed."""
    shutil.rmtree(Path(folder) / _FOLDER, ignore_errors=True)


@dataclass(frozen=True, eq=False)
class _Rows:
    """An episode as training needs it."""

    path: Path
    actions: np.ndarray  # (T, 7) float64
    ground_truth: np.ndarray  # (T + 1, D) float32


class Demonstrations:
    """Demonstrations of one task, of which `count` were chosen for training run `seed`.

    Pictures stay on the disk: one transition takes two reads, and memory holds only actions and
    ground truth. Building reads each chosen episode once, unless the cache has it.

    Recordings that were imported from the original code count as it counts them: it keeps failed
    ones, but in bag-color-goal those alone that score above 0.5, and of bag-items those alone that
    are solved. Imported ones that do not count, and those without an action, are left out
    (`left_out` says how many).

    Corrected episodes (`warp_deform.episodes.corrected`) count whether they are solved or not.
    Their transitions are the states that have a label, with the label for an action; their goal is
    the one that the teacher went for, not their end. `as_played` takes what the policy did instead,
    in all states, of which `color` shows the next one, too.

    Args:
        folder: what `warp-deform demo` or `warp-deform correct` wrote
        task: the task that must be in it
        count: demonstrations to learn from; None takes all but the spare ones
        seed: which ones, see `choose`
        spare: how many others there have to be, see `spared`
        goal: of a demonstration; "end" takes how it ended (hindsight, the paper's), "own" the goal
            that it was recorded with
        as_played: whether to learn what was done and where it led, of corrected episodes too

    Raises:
        InputError: no folder, another task's episodes, failures among them, or too few; one went
            for a goal of tests; goals of their own are learnt, and they have none, or such as show
            what goals of tests do not (`Task.goal_shows_its_start`).

    Source: Seita et al., ICRA 2021, code that records demonstrations.
    """

    def __init__(
        self,
        folder: Path,
        *,
        task: str,
        count: int | None = None,
        seed: int = 0,
        spare: int = 0,
        goal: GoalName = "end",
        as_played: bool = False,
    ) -> None:
        self.task = find_task(task)
        reader = EpisodeReader(Path(folder))
        index = read_index(Path(folder))["episodes"]
        seeds: list[int] = []
        for name, entry in sorted(index.items()):
            if entry["task"] != task:
                raise InputError(
                    f"{Path(folder) / name} is an episode of {entry['task']}, not of {task}; "
                    "name the folder of its demonstrations"
                )
            if _counts(entry):
                seeds.append(entry["seed"])
            elif entry["demonstrator"] != _IMPORTED:
                raise InputError(
                    f"{Path(folder) / name} is no successful demonstration; train on a folder "
                    "that `warp-deform demo` wrote"
                )
        check_learnt_goals(reader, seeds, self.task, goal="played" if as_played else goal)
        self.left_out = len(reader) - len(seeds)
        if not seeds:
            raise InputError(f"{folder}: none of its {len(reader)} episodes is a demonstration")
        if count is None:
            count = len(seeds) - spare
        chosen = choose(tuple(seeds), count, seed=seed)
        rest = tuple(sorted(set(seeds) - set(chosen)))
        if spare > len(rest):
            raise InputError(
                f"{folder} holds {len(seeds)} demonstrations, too few to learn from {count} and "
                f"hold out {spare}; collect more"
            )
        self._reader, self._index, self._seed, self._rest = reader, index, seed, rest
        self._kind: LearntGoal = "played" if as_played else goal
        self._take(chosen)

    def _take(self, seeds: tuple[int, ...]) -> None:
        self.seeds = seeds
        self.seals = tuple(self._index[episode_name(number)]["seal"] for number in seeds)
        cache, kind = self._reader.folder / _FOLDER, "" if self._kind == "end" else f"-{self._kind}"
        self._episodes = [
            _open(
                self._reader, number, cache / f"{number:09d}-{seal}-{_FORMAT}{kind}.npy", self._kind
            )
            for number, seal in zip(self.seeds, self.seals, strict=True)
        ]

    def spared(self, count: int) -> Demonstrations:
        """So many others, drawn from those that are not among these."""
        spared = copy.copy(self)
        spared._take(choose(self._rest, count, seed=self._seed))
        return spared

    def __len__(self) -> int:
        """Number of demonstrations."""
        return len(self._episodes)

    def actions(self) -> Iterator[tuple[str, np.ndarray]]:
        """Of every demonstration the name of its file, and its actions (T, 7)."""
        for seed, episode in zip(self.seeds, self._episodes, strict=True):
            yield episode_name(seed), episode.actions

    def lengths(self) -> list[int]:
        """Actions, or labels, of every demonstration."""
        return [len(episode.actions) for episode in self._episodes]

    @property
    def corrected(self) -> int:
        """How many of them are corrected episodes."""
        names = (self._index[episode_name(seed)]["demonstrator"] for seed in self.seeds)
        return sum(map(is_corrected, names))

    @property
    def given_goals(self) -> list[int]:
        """Seeds of the goals of those that went for given ones, see `warp-deform demo --goals`."""
        return given_goals(map(self._reader.info, self.seeds))

    @property
    def state_size(self) -> int:
        """Length of a ground-truth state.

        Raises:
            InputError: the recordings have none, as those of robots and of the original code.
        """
        size = int(self._episodes[0].ground_truth.shape[1])
        if size == 0:
            raise InputError(
                "these demonstrations hold no ground truth; train an agent that sees pictures"
            )
        return size

    def drawn(self, count: int, rng: np.random.Generator) -> Iterator[tuple[int, int]]:
        """So many times a demonstration, then one of its transitions, each drawn uniformly.

        Each is drawn when it is asked for, so `rng` may serve between the draws.

        Source: Seita et al., ICRA 2021, code of the training loop.
        """
        for _ in range(count):
            episode = int(rng.integers(len(self._episodes)))
            yield episode, int(rng.integers(len(self._episodes[episode].actions)))

    def transition(self, episode: int, t: int) -> Transition:
        """Transition t of a demonstration, with its goal."""
        recorded = self._episodes[episode]
        rows = np.load(recorded.path, mmap_mode="r", allow_pickle=False)
        now, end = rows[t], rows[-1]
        return Transition(
            np.array(now["color"]),
            np.array(now["height"]),
            np.array(end["color"]),
            np.array(end["height"]),
            recorded.actions[t],
        )

    def color(self, episode: int, t: int) -> np.ndarray:
        """Colour picture (H, W, 3) uint8 of state t of a demonstration, its end the last."""
        rows = np.load(self._episodes[episode].path, mmap_mode="r", allow_pickle=False)
        return np.array(rows[t]["color"])

    def action(self, episode: int, t: int) -> np.ndarray:
        """Action (7,) of transition t."""
        return np.array(self._episodes[episode].actions[t])

    def state(self, episode: int, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Ground truth (D,) float32 before transition t, and its action (7,).

        Where the task has a goal, the second half is the goal's state, of the goal of `transition`.
        """
        recorded = self._episodes[episode]
        state = recorded.ground_truth[t].copy()
        if self.task.goal_conditioned:
            half = len(state) // 2
            state[half:] = recorded.ground_truth[-1, :half]
        return state, recorded.actions[t]


def _counts(entry: Mapping[str, Any]) -> bool:
    """Whether an episode, as the index has it, is a demonstration."""
    if entry["actions"] == 0:
        return False
    if is_corrected(entry["demonstrator"]):
        return True  # what is learnt from it is the teacher's
    if entry["demonstrator"] != _IMPORTED or entry["task"] in _IMPORTED_SOLVED:
        return bool(entry["success"])
    least = _IMPORTED_ABOVE.get(entry["task"])
    return least is None or entry["score"] > least


def _open(reader: EpisodeReader, seed: int, path: Path, kind: LearntGoal) -> _Rows:
    """The cached rows of an episode, made first where they are missing or damaged."""
    try:
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
        if rows.dtype.names != _COLUMNS or rows.ndim != 1 or len(rows) < 2:
            raise ValueError("something else under this name")
    except (OSError, ValueError, EOFError):  # not made yet, or cut short by a full disk
        _write(_rows(_learnt(reader.read(seed), kind, what=reader.path(seed))), path)
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    return _Rows(path, np.array(rows["action"][:-1]), np.array(rows["ground_truth"]))


def _learnt(episode: Episode, kind: LearntGoal, *, what: Path) -> Episode:
    """An episode as it is learnt from: states with what is to be done in them, then its goal.

    Raises:
        InputError: there is no label, or no goal of its own.
    """
    if kind == "played":
        return episode
    if is_corrected(episode.info.demonstrator):
        labels = labels_of(episode.info, what=what)
        steps = [
            replace(step, action=label)
            for step, label in zip(episode.steps, labels, strict=False)
            if label is not None
        ]
        if not steps:
            raise InputError(f"{what} holds no label; remove it")
        end = episode.steps[-1]
        return replace(episode, steps=(*steps, end if episode.goal is None else _aimed_at(episode)))
    if kind == "end":
        return episode
    if episode.goal is None:
        raise InputError(f"{what} has no goal of its own; leave --goal out")
    return replace(episode, steps=(*episode.steps[:-1], _aimed_at(episode)))


def _aimed_at(episode: Episode) -> Step:
    """The last state of an episode as if its goal had been reached."""
    end = episode.steps[-1]
    assert episode.goal is not None
    half = len(end.ground_truth) // 2  # in the second one stands the goal's state
    truth = np.concatenate([end.ground_truth[half:], end.ground_truth[half:]])
    return replace(end, color=episode.goal.color, height=episode.goal.height, ground_truth=truth)


def _rows(episode: Episode) -> np.ndarray:
    """An episode as a structured array; the action of its last row is not a number."""
    first = episode.steps[0]
    shape = first.height.shape
    kind = np.dtype(
        [
            (_COLUMNS[0], "u1", (*shape, 3)),
            (_COLUMNS[1], "<f4", shape),
            (_COLUMNS[2], "<f8", (7,)),
            (_COLUMNS[3], "<f4", first.ground_truth.shape),
        ]
    )
    rows = np.zeros(len(episode.steps), kind)
    for row, step in zip(rows, episode.steps, strict=True):
        row["color"], row["height"] = step.color, step.height
        row["action"] = np.nan if step.action is None else step.action
        row["ground_truth"] = step.ground_truth
    return rows


def _write(rows: np.ndarray, path: Path) -> None:
    """Store rows, whole or not at all."""
    try:
        path.parent.mkdir(exist_ok=True)
        with whole_file(path) as temporary, temporary.open("xb") as file:
            np.save(file, rows, allow_pickle=False)
    except OSError as error:
        raise InputError(
            f"the cache {path.parent} cannot be written ({error.strerror}); make room or copy the "
            "demonstrations to where you may write"
        ) from error
