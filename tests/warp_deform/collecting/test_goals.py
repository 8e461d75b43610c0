"""Goal sets: made, read back, and aimed at."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.goals import load_goal, load_goals
from warp_deform.collecting.make_goals import GOAL_SEED, make_goals
from warp_deform.collecting.replay import verify
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.worlds import Worlds

TASK = "cable-line-notarget"


@pytest.fixture(scope="module")
def demonstrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demonstrated")
    report = make_goals(TASK, out, count=2, workers=1)
    assert (report["kind"], report["goals"], report["physics_ok"]) == ("demonstrated", 2, True)
    return out


@pytest.fixture(scope="module")
def constructed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("constructed")
    report = make_goals(TASK, out, count=3, kind="constructed")
    assert (report["kind"], report["goals"], report["attempts"]) == ("constructed", 3, 3)
    return out


def test_a_demonstrated_goal_is_where_the_demonstration_ended(demonstrated: Path) -> None:
    reader = EpisodeReader(demonstrated)
    assert reader.seeds[0] == GOAL_SEED
    for seed, goal in zip(reader.seeds, load_goals(demonstrated), strict=True):
        last = reader.read(seed).steps[-1]
        assert (goal.kind, goal.seed) == ("demonstrated", seed)
        assert np.array_equal(goal.color, last.color)
        assert np.array_equal(goal.height, last.height)
        assert np.array_equal(goal.targets, last.particle_q[:, :2])


def test_a_constructed_goal_is_the_one_that_its_seed_gets(constructed: Path) -> None:
    reader = EpisodeReader(constructed)
    assert [info.actions for info in reader.infos()] == [0, 0, 0]
    assert all(info.success for info in reader.infos())
    worlds = Worlds(TASK, 3, lanes=8)
    worlds.reset(dict(enumerate(reader.seeds)))
    first_draw = [slot for slot, made in worlds.episodes.items() if not made.discarded_starts]
    assert first_draw, "a start that is drawn again comes with another goal"
    for slot in first_draw:
        seed = reader.seeds[slot]
        goal, expected = load_goal(reader.path(seed)), worlds.episodes[slot].goal
        assert expected is not None and goal.kind == "constructed"
        assert np.array_equal(goal.targets, expected.targets)
        assert np.array_equal(goal.color, expected.color)
        stored = reader.read_goal(seed)
        assert stored is not None and np.array_equal(stored.targets, goal.targets)


def test_a_set_grows_without_changing(constructed: Path, tmp_path: Path) -> None:
    growing = tmp_path / "goals"  # other tests count those of the fixture
    shutil.copytree(constructed, growing)
    before = {path.name: path.read_bytes() for path in growing.glob("*.parquet")}
    make_goals(TASK, growing, count=4, kind="constructed")
    after = {path.name: path.read_bytes() for path in growing.glob("*.parquet")}
    assert len(after) == 4 and before.items() <= after.items()


def test_goals_replay(constructed: Path, demonstrated: Path) -> None:
    for folder in (constructed, demonstrated):
        report = verify(folder, workers=1)
        assert report["mismatches"] == 0 and report["steps"] >= report["episodes"] > 0


def test_demonstrations_aim_at_given_goals(constructed: Path, tmp_path: Path) -> None:
    goals = load_goals(constructed)[:3]
    report = collect(
        CollectConfig(task=TASK, episodes=2, seed=20, out=tmp_path, goals=constructed, workers=1)
    )
    assert report.success_rate > 0
    for episode in EpisodeReader(tmp_path):
        assert episode.goal is not None
        [aim] = [goal for goal in goals if goal.seed == episode.goal.seed]
        assert np.array_equal(episode.goal.targets, aim.targets)
        beads = episode.steps[-1].particle_q[:, :2]
        assert np.linalg.norm(beads - aim.targets, axis=1).max() < 0.05
    assert verify(tmp_path, workers=1)["mismatches"] == 0


def test_wrong_requests_are_refused(constructed: Path, demonstrated: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has no goal image"):
        make_goals("cable-ring", tmp_path, count=1)
    with pytest.raises(InputError, match="has no goal image, so no goals can be given"):
        CollectConfig(task="cable-ring", out=tmp_path, goals=constructed)
    with pytest.raises(InputError, match=f"holds goals of {TASK}, not of block-notarget"):
        CollectConfig(task="block-notarget", out=tmp_path, goals=constructed)
    with pytest.raises(InputError, match="--goals does not go with --control"):
        CollectConfig(task=TASK, out=tmp_path, goals=constructed, control=True)
    with pytest.raises(InputError, match="kind is 'drawn'"):
        make_goals(TASK, tmp_path, count=1, kind="drawn")
    for seed in (-1, 999_999_999):
        with pytest.raises(InputError, match="it must be 0 to 999999998"):
            make_goals(TASK, tmp_path, count=2, seed=seed, kind="constructed")
    with pytest.raises(InputError, match="count is 0"):
        make_goals(TASK, tmp_path, count=0)
    with pytest.raises(InputError, match="of another kind"):
        make_goals(TASK, constructed, count=1, kind="demonstrated")
    with pytest.raises(InputError, match="of another kind"):
        make_goals(TASK, demonstrated, count=1, kind="constructed")
    with pytest.raises(InputError, match="holds no episodes"):
        load_goals(tmp_path)
    with pytest.raises(InputError, match="not named"):
        load_goal(tmp_path / "goal.parquet")
