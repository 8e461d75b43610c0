"""Demonstrations for training: the right pictures, the right subset, little memory."""

from __future__ import annotations

import dataclasses
import resource
import sys
from pathlib import Path

import numpy as np
import pytest
from fixtures.episode_samples import with_info
from fixtures.training_samples import block_episode, write_demonstrations

from learning.data.dataset import Demonstrations, choose
from learning.data.goals import TEST_GOALS
from learning.evaluation import protocol
from learning.evaluation.protocol import FIRST_SEED, Protocol
from learning.interchange.original_recording import DEMONSTRATOR
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.episodes import HEIGHT_UNIT, Episode, EpisodeReader, EpisodeWriter
from warp_deform.episodes.goals import GOAL_GIVEN
from warp_deform.errors import InputError
from warp_deform.tasks.task import Task

TASK = "cable-line-notarget"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("data") / "demos", 4)


def test_a_moment_is_what_was_recorded_and_its_goal_the_end(folder: Path) -> None:
    data = Demonstrations(folder, task=TASK)
    for episode, seed in enumerate(data.seeds):
        recorded = EpisodeReader(folder).read(seed)
        for t in range(2):
            transition = data.transition(episode, t)
            assert (transition.color == recorded.steps[t].color).all()
            assert (transition.height == recorded.steps[t].height).all()
            assert (transition.goal_color == recorded.steps[-1].color).all()
            assert (transition.goal_height == recorded.steps[-1].height).all()
            assert (
                np.abs(transition.height - block_episode(seed).steps[t].height).max() < HEIGHT_UNIT
            )
            assert (transition.action == recorded.steps[t].action).all()


def test_the_goal_in_a_state_is_the_end_too(folder: Path) -> None:
    data = Demonstrations(folder, task=TASK)
    state, _ = data.state(0, 1)
    recorded = EpisodeReader(folder).read(data.seeds[0]).steps
    assert (state[:72] == recorded[1].ground_truth[:72]).all()
    assert (state[72:] == recorded[-1].ground_truth[:72]).all()


def test_the_goal_is_the_demonstration_s_own_where_that_is_asked_for(folder: Path) -> None:
    """Of pictures and states, of what is spared too; the end stays the goal of who asks for it."""
    own = Demonstrations(folder, task=TASK, count=2, spare=2, goal="own")
    end = Demonstrations(folder, task=TASK, count=2, spare=2)
    for mine, theirs in ((own, end), (own.spared(2), end.spared(2))):
        assert mine.seeds == theirs.seeds
        for episode, seed in enumerate(mine.seeds):
            recorded = EpisodeReader(folder).read(seed)
            one, other = mine.transition(episode, 1), theirs.transition(episode, 1)
            assert (one.goal_color == recorded.goal.color).all()
            assert (one.goal_height == recorded.goal.height).all()
            assert (other.goal_color == recorded.steps[-1].color).all()
            assert not (one.goal_color == other.goal_color).all()
            assert (one.color == other.color).all() and (one.action == other.action).all()
            state, _ = mine.state(episode, 1)
            assert (state[:72] == recorded.steps[1].ground_truth[:72]).all()
            # what went for a goal has the goal's state in the second half of its own
            assert (state[72:] == recorded.steps[-1].ground_truth[72:]).all()


def test_a_recording_without_a_goal_has_none_of_its_own(tmp_path: Path) -> None:
    EpisodeWriter(tmp_path).write(dataclasses.replace(block_episode(0), goal=None))
    with pytest.raises(InputError, match="no goal of its own; leave --goal out"):
        Demonstrations(tmp_path, task=TASK, goal="own")
    assert len(Demonstrations(tmp_path, task=TASK)) == 1


def test_a_goal_of_the_start_s_own_is_refused_where_it_shows_what_tests_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of any demonstration of the folder, also one that is held out, and with its rows cached."""
    for number, seed in ((0, 0), (1, 200_000)):
        _aimed(tmp_path / "mixed", number, seed=seed)
        _aimed(tmp_path / str(seed), number, seed=seed)
    _aimed(tmp_path / "ends", 0, seed=0, kind="demonstrated")  # as imported ones have
    _aimed(tmp_path / "given", 0, seed=0, given=True)
    assert len(Demonstrations(tmp_path / "0", task=TASK, goal="own")) == 1  # which leaves a cache
    monkeypatch.setattr(Task, "goal_shows_its_start", lambda task: True)
    for fine in ("200000", "given"):
        assert len(Demonstrations(tmp_path / fine, task=TASK, goal="own")) == 1
    for seed in (0, 1):
        with pytest.raises(InputError, match=r"shows the rest of that start.*or leave --goal out"):
            Demonstrations(tmp_path / "mixed", task=TASK, goal="own", count=1, seed=seed)
    for refused in ("0", "ends"):
        with pytest.raises(InputError, match=r"--kind constructed --seed 200000 .*demo --goals"):
            Demonstrations(tmp_path / refused, task=TASK, goal="own")
        assert len(Demonstrations(tmp_path / refused, task=TASK)) == 1


def test_goals_of_tests_are_not_learnt_from(tmp_path: Path) -> None:
    """Nor their ends, nor what led to them."""
    for seed in (99_999, 100_000, 140_000, 199_999, 200_000):
        for kind in ("constructed", "demonstrated"):
            folder = tmp_path / kind / str(seed)
            _aimed(folder, 0, seed=seed, kind=kind)
            for how in ({"goal": "own"}, {"goal": "end"}, {"as_played": True}):
                if seed in (99_999, 200_000):
                    assert len(Demonstrations(folder, task=TASK, **how)) == 1
                    continue
                with pytest.raises(InputError, match=f"of seed {seed}, one of those of tests") as e:
                    Demonstrations(folder, task=TASK, **how)
                assert "leave --goal out" not in str(e.value), "that would be refused, too"


def test_given_goals_are_told_from_own_ones(tmp_path: Path) -> None:
    """By what an episode says, or by the seeds."""
    for number, (seed, given) in enumerate([(0, False), (1, True), (200_000, False)]):
        _aimed(tmp_path, number, seed=seed, given=given)
    EpisodeWriter(tmp_path).write(dataclasses.replace(block_episode(3), goal=None))
    assert Demonstrations(tmp_path, task=TASK).given_goals == [1, 200_000]


def test_seeds_of_tests_goals_are_those_of_the_protocol() -> None:
    made = [protocol._goal_seed(Protocol(split=split, episodes=200)) for split in FIRST_SEED]
    assert min(made) == TEST_GOALS.start and max(made) + 200 in TEST_GOALS


def _aimed(
    folder: Path, number: int, *, seed: int, kind: str = "constructed", given: bool = False
) -> None:
    """Write an episode whose goal is of a kind, made of a seed, and perhaps given to it."""
    episode = block_episode(number)
    assert episode.goal is not None
    goal = dataclasses.replace(episode.goal, seed=seed, kind=kind)
    if given:
        episode = with_info(episode, extra={GOAL_GIVEN: True})
    EpisodeWriter(folder).write(dataclasses.replace(episode, goal=goal))


def test_goals_of_their_own_are_another_run_and_need_a_task_with_goals(
    folder: Path, tmp_path: Path
) -> None:
    def begin(**changes) -> str:
        schedule = Schedule(steps=2, batch=1, lr=1e-3, snapshots=1)
        values = {"task": TASK, "agent": "gt-mlp", "preset": "fast", "schedule": schedule}
        config = TrainConfig(data=folder, out=tmp_path / "run", **values | changes)
        return train(config).weights_hash

    weights = begin(goal="own")
    assert begin(goal="own") == weights
    with pytest.raises(InputError, match="holds a run with another goal"):
        begin()
    with pytest.raises(InputError, match="cable-ring has no goals; leave --goal out"):
        begin(task="cable-ring", goal="own")
    with pytest.raises(InputError, match="goal is 'start'; it must be one of"):
        begin(goal="start")


def test_a_task_without_goal_keeps_its_state(tmp_path: Path) -> None:
    write_demonstrations(tmp_path, 1, task="cable-ring")
    data = Demonstrations(tmp_path, task="cable-ring")
    assert (data.state(0, 0)[0] == EpisodeReader(tmp_path).read(0).steps[0].ground_truth).all()


def test_the_cache_follows_the_episodes(tmp_path: Path) -> None:
    write_demonstrations(tmp_path, 2)
    before = Demonstrations(tmp_path, task=TASK).transition(0, 0)
    cached = sorted((tmp_path / "rows").iterdir())
    cached[0].write_bytes(cached[0].read_bytes()[:100])  # cut short
    assert (Demonstrations(tmp_path, task=TASK).transition(0, 0).color == before.color).all()
    (tmp_path / "episode_000000000.parquet").unlink()
    EpisodeWriter(tmp_path).write(with_info(block_episode(7), seed=0))
    after = Demonstrations(tmp_path, task=TASK).transition(0, 0)
    assert (after.color == block_episode(7).steps[0].color).all()


def test_transitions_are_drawn_uniformly_over_episodes_then_steps(tmp_path: Path) -> None:
    writer = EpisodeWriter(tmp_path)
    for seed, actions in ((0, 1), (1, 4)):
        writer.write(block_episode(seed, actions=actions))
    data, rng = Demonstrations(tmp_path, task=TASK), np.random.default_rng(0)
    drawn = list(data.drawn(4000, rng))
    shares = [drawn.count((0, 0)) / 4000, *(drawn.count((1, t)) / 4000 for t in range(4))]
    assert np.abs(np.array(shares) - [0.5, 0.125, 0.125, 0.125, 0.125]).max() < 0.03


def test_subsets_are_drawn_by_the_seed() -> None:
    seeds = tuple(range(0, 2000, 2))
    subsets = [choose(seeds, 100, seed=run) for run in (0, 0, 1)]
    assert subsets[0] == subsets[1] != subsets[2]
    assert all(len(set(s)) == 100 and set(s) <= set(seeds) for s in subsets)
    assert choose(seeds, 1000, seed=5) == seeds


@pytest.mark.parametrize("count", [0, -1, 5])
def test_a_number_of_demonstrations_that_is_not_there(folder: Path, count: int) -> None:
    with pytest.raises(InputError, match="the data holds 4 demonstrations"):
        Demonstrations(folder, task=TASK, count=count)


def test_what_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"episode of cable-line-notarget, not of cable-ring"):
        Demonstrations(folder, task="cable-ring")
    with pytest.raises(InputError, match="cannot be read as a folder"):
        Demonstrations(tmp_path / "missing", task=TASK)
    with pytest.raises(InputError, match="holds no episodes"):
        Demonstrations(tmp_path, task=TASK)
    EpisodeWriter(tmp_path).write(with_info(block_episode(0), success=False))
    with pytest.raises(InputError, match="no successful demonstration"):
        Demonstrations(tmp_path, task=TASK)


def imported(seed: int, *, task: str = TASK, **changes: object) -> Episode:
    """An episode as it is imported from the original code, failed."""
    info = {"demonstrator": DEMONSTRATOR, "success": False, "task": task, **changes}
    return with_info(block_episode(seed), **info)


def test_the_originals_failures_are_demonstrations_as_there(tmp_path: Path) -> None:
    """They are kept there, but for those that began solved and so have no action."""
    writer = EpisodeWriter(tmp_path)
    writer.write(imported(0))
    writer.write(imported(1, success=True))
    still = block_episode(2, actions=0)
    writer.write(with_info(still, demonstrator=DEMONSTRATOR, success=True))
    data = Demonstrations(tmp_path, task=TASK)
    assert data.seeds == (0, 1) and data.left_out == 1
    one = Demonstrations(tmp_path, task=TASK, count=2)
    assert one.seeds == (0, 1)
    with pytest.raises(InputError, match="the data holds 2 demonstrations"):
        Demonstrations(tmp_path, task=TASK, count=3)
    schedule = Schedule(steps=1, batch=1, lr=1e-3, snapshots=1)
    out = tmp_path / "run"
    report = train(
        TrainConfig(task=TASK, agent="gt-mlp", data=tmp_path, out=out, schedule=schedule)
    )
    assert (report.demos, report.left_out) == (2, 1)
    assert RunFolder(out).read_settings()["left_out"] == 1


def test_of_the_originals_bags_by_color_only_good_ones_count(tmp_path: Path) -> None:
    task, writer = "bag-color-goal", EpisodeWriter(tmp_path)
    for seed, score in enumerate((0.5, 0.51, 1.0, 0.0)):
        writer.write(imported(seed, task=task, score=score))
    data = Demonstrations(tmp_path, task=task)
    assert data.seeds == (1, 2) and data.left_out == 2
    for seed in data.seeds:
        (tmp_path / f"episode_{seed:09d}.parquet").unlink()
    with pytest.raises(InputError, match="none of its 2 episodes is a demonstration"):
        Demonstrations(tmp_path, task=task)


@pytest.mark.parametrize("task", ["bag-items-1", "bag-items-2"])
def test_of_the_originals_bags_with_items_only_the_solved_count(tmp_path: Path, task: str) -> None:
    writer = EpisodeWriter(tmp_path)
    for seed, (score, success) in enumerate(((0.75, False), (0.6, True), (0.5, False))):
        writer.write(imported(seed, task=task, score=score, success=success))
    data = Demonstrations(tmp_path, task=task)
    assert data.seeds == (1,) and data.left_out == 2


def test_what_holds_no_state_trains_no_agent_over_states(tmp_path: Path) -> None:
    made = block_episode(0)
    bare = [dataclasses.replace(step, ground_truth=np.zeros(0, np.float32)) for step in made.steps]
    EpisodeWriter(tmp_path).write(dataclasses.replace(made, steps=tuple(bare)))
    data = Demonstrations(tmp_path, task=TASK)
    with pytest.raises(InputError, match="hold no ground truth"):
        print(data.state_size)


def test_pictures_stay_on_the_disk(tmp_path: Path) -> None:
    """40 episodes of 5 rows hold 72 MB of pictures; looking at all of them adds far less."""
    write_demonstrations(tmp_path, 40, actions=4)
    data = Demonstrations(tmp_path, task=TASK)
    before = _resident()
    for episode in range(40):
        for t in range(4):
            data.transition(episode, t)
    assert _resident() - before < 20e6


def _resident() -> float:
    """Memory in use by this process now [B], its mapped files included."""
    if sys.platform == "linux":
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
