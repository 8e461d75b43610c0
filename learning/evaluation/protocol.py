"""What a snapshot plays: seeds, goals, who chooses the lift; and that splits stay apart.

Seeds of validation (50,000 and up), test (10,000 and up) and goals (100,000 and up) are apart from
those of training.

Source: Seita et al., ICRA 2021, sections on training and evaluation.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Literal

from warp_deform.collecting.collect import most_attempts
from warp_deform.collecting.folder import check_seeds
from warp_deform.collecting.goals import check_goals, load_goal
from warp_deform.collecting.make_goals import GOAL_SEED, make_goals
from warp_deform.episodes import EpisodeReader, Goal
from warp_deform.errors import InputError
from warp_deform.tasks.registry import task as find_task

from ..runs.folder import RunFolder

__all__ = ["FIRST_SEED", "Protocol", "check_splits", "goals_for", "goals_of"]

FIRST_SEED = {"validation": 50_000, "test": 10_000}
"""First seed of each split's episodes."""


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """What a snapshot plays.

    Attributes:
        split: "validation" or "test", whose seeds are played
        episodes: their number, from the split's first seed on
        first_seed: of test episodes, in place of the split's
        goals: "constructed": for test from goal seeds; for validation from the episode's own seed,
            or from goal seeds where such a goal would show more of the start than a test's does,
            see `Task.goal_shows_its_start`; "demonstrated": ends of demonstrations on goal seeds,
            the paper's
        n_goals: goals that the episodes share in turn
        goal_folder: a folder of goals that the test episodes share in turn instead
        stage_rule: who chooses the lift, "action" (the policy) or "privileged" (the paper's hidden
            rule, which reads the simulator)
        retry: whether agents over pictures remember what they missed, just put down and did twice,
            and pick elsewhere, see `policy.RetryingPolicy`; the paper's do not
        motions_must_succeed: whether an action that the arm cannot carry out ends the episode,
            unsolved, as in the original; else it costs an action
    """

    split: Literal["validation", "test"]
    episodes: int
    goals: Literal["constructed", "demonstrated"] = "constructed"
    n_goals: int = 200
    goal_folder: Path | None = None
    stage_rule: Literal["action", "privileged"] = "action"
    retry: bool = True
    robot: str = "ur5"
    first_seed: int | None = None
    motions_must_succeed: bool = False

    def __post_init__(self) -> None:
        if self.first_seed is not None:
            check_seeds(self.first_seed, self.episodes)
        if self.episodes < 1 or self.n_goals < 1:
            raise InputError(
                f"episodes is {self.episodes} and n_goals {self.n_goals}; they must be 1 or more"
            )

    @property
    def seeds(self) -> range:
        """Seeds of the episodes."""
        first = FIRST_SEED[self.split] if self.first_seed is None else self.first_seed
        return range(first, first + self.episodes)

    @property
    def given(self) -> Path | None:
        """The folder of goals that is in force."""
        return self.goal_folder if self.split == "test" else None

    def makes_goals(self, task: str) -> bool:
        """Whether the episodes share goals that are made for them."""
        known = find_task(task)
        own = self.split == "validation" and self.goals == "constructed"
        if not known.goal_conditioned or self.given is not None:
            return False
        return not own or known.goal_shows_its_start()


def goals_for(run: RunFolder, task: str, protocol: Protocol) -> Path | None:
    """Folder of the goals to play for, made if need be; None: every seed constructs its own.

    Goal k depends on neither their number nor that of the episodes, so the folder grows with both.

    Raises:
        InputError: the protocol's folder holds no goals of the task.
    """
    if protocol.given is not None:
        return check_goals(protocol.given, task)
    if not protocol.makes_goals(task):
        return None
    seed = _goal_seed(protocol)
    folder = run.path / "goals" / f"{protocol.goals}-{seed}-{protocol.robot}"
    count = min(protocol.n_goals, protocol.episodes)
    present = sum(1 for _ in folder.glob("episode_*.parquet"))
    made = make_goals(
        task,
        folder,
        count=max(count, present),
        seed=seed,
        kind=protocol.goals,
        robot=protocol.robot,
        workers=1,
    )
    if made["goals"] < count:
        raise InputError(f"only {made['goals']} of {count} goals of {task} could be made")
    return folder


def goals_of(folder: Path, protocol: Protocol, seeds: Sequence[int]) -> dict[int, Goal]:
    """The goals of the episodes of `seeds`, in the folder that `goals_for` gave.

    The split's episode k has goal k, modulo `n_goals`; in a folder that was given, modulo the
    number that it holds.

    Raises:
        InputError: the folder is missing, or what it holds is no goal.
    """
    reader = EpisodeReader(folder)
    number = protocol.n_goals if protocol.given is None else len(reader)
    turns = {seed: (seed - protocol.seeds.start) % number for seed in seeds}
    goals = {k: load_goal(reader.path(reader.seeds[k])) for k in set(turns.values())}
    return {seed: goals[k] for seed, k in turns.items()}


def check_splits(
    trained: Iterable[int], protocols: Sequence[Protocol], *, task: str, goals: Iterable[int] = ()
) -> None:
    """Refuse protocols that would play what was trained on, or share seeds among their splits.

    Args:
        trained: seeds of the demonstrations
        goals: seeds of the goals that were given to these

    Raises:
        InputError: a seed of training is one of the episodes or goals, a goal was one of training,
            or a seed of an episode is that of another split's or of a goal.
    """
    known, learnt = sorted(trained), set(goals)
    splits: dict[str, range] = {}
    for protocol in protocols:
        parts: dict[str, range] = {protocol.split: protocol.seeds}
        if protocol.makes_goals(task):
            made = _made_goals(protocol)
            if made.start != protocol.seeds.start:
                parts[f"{protocol.split} goal"] = made
        for name, seeds in parts.items():
            before = splits.get(name, seeds)
            splits[name] = range(seeds.start, max(seeds.stop, before.stop))
        shown = () if protocol.given is None else EpisodeReader(protocol.given).seeds
        if both := set(known) & set(shown):
            raise InputError(
                f"seed {min(both)} is one of training and of the goals in {protocol.given}; give "
                "goals of other seeds"
            )
        played = _goals_played(protocol, task)
        if both := {seed for seed in learnt if seed in played}:
            raise InputError(
                f"training went for the goal of seed {min(both)}, which is one of those of "
                f"{protocol.split}; choose others by --goals or --first-seed"
            )
    for split, seeds in splits.items():
        hit = next((seed for seed in known if seed in seeds), None)
        if hit is not None:
            raise InputError(
                f"seed {hit} is one of training and of the {split} seeds {seeds.start} to "
                f"{seeds.stop - 1}; train on demonstrations of other seeds, or play fewer episodes"
            )
    for (mine, a), (theirs, b) in combinations(splits.items(), 2):
        shared = range(max(a.start, b.start), min(a.stop, b.stop))
        if shared:
            raise InputError(
                f"seed {shared.start} is one of {mine} and of {theirs}; play fewer episodes"
            )


def _goals_played(protocol: Protocol, task: str) -> Sequence[int]:
    """Seeds of the goals that a protocol can play for."""
    if not find_task(task).goal_conditioned:
        return ()
    if protocol.given is not None:
        return EpisodeReader(protocol.given).seeds
    if not protocol.makes_goals(task):
        return protocol.seeds  # each makes its own
    return _made_goals(protocol)


def _made_goals(protocol: Protocol) -> range:
    """Seeds from which goals are made for a protocol."""
    first, count = _goal_seed(protocol), min(protocol.n_goals, protocol.episodes)
    most = most_attempts(count) if protocol.goals == "demonstrated" else count
    return range(first, first + most)


def _goal_seed(protocol: Protocol) -> int:
    """First seed of goals that are made; validation and other test seeds have their own."""
    if protocol.split == "validation" and protocol.goals == "demonstrated":
        return FIRST_SEED["validation"]
    return GOAL_SEED + protocol.seeds.start - FIRST_SEED["test"]
