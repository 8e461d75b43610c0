"""Demonstrators by name, and the saved states that looking ahead rests on."""

from __future__ import annotations

from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest

from warp_deform import PickPlaceEnv
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.replay import verify
from warp_deform.collecting.workers import single_threaded
from warp_deform.command.main import main
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.planning import Outlook
from warp_deform.planning import demonstrators as demonstrating
from warp_deform.planning.demonstrators import CANDIDATES, DEMONSTRATORS, demonstrator
from warp_deform.tasks.demonstrators import met_particle
from warp_deform.worlds import Worlds
from warp_deform.worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from warp_deform.worlds.loop import SOLVED, EpisodeRun, play

LINE, BLOCK, RING = "cable-line-notarget", "block-notarget", "cable-ring"
SAMPLES = [
    RING,
    BLOCK,
    "fabric-flat",
    pytest.param("bag-items-2", marks=pytest.mark.in_a_row("bags")),
]


@cache
def worlds(name: str, count: int) -> Worlds:
    """Worlds that tests share; every test resets the slots it uses."""
    return Worlds(name, count, lanes=8)


def runs_of(side: Worlds, seeds: list[int]) -> dict[int, EpisodeRun[Any]]:
    """Start the seeds in the first slots."""
    side.reset(dict(enumerate(seeds)))
    return {
        i: EpisodeRun(seed, episode_rng(seed, DEMONSTRATOR_STREAM)) for i, seed in enumerate(seeds)
    }


def played(side: Worlds, seeds: list[int], name: str) -> dict[int, EpisodeRun[str]]:
    """Whole episodes, with hashes of their states."""
    act = demonstrator(name)
    with single_threaded():
        return {run.seed: run for _, run in play(side, seeds, act=act, look=Worlds.hash)}


# -- states


@pytest.mark.parametrize("name", SAMPLES)
def test_a_restored_state_goes_on_bit_for_bit_in_any_slot_and_worlds(name: str) -> None:
    side, other = worlds(name, 2), Worlds(name, 3, lanes=1)
    run = runs_of(side, [3])[0]

    def act() -> np.ndarray:
        episode = side.episodes[0]
        action = side.task.demonstrate(episode.layout, episode.snapshot, run.rng)
        assert action is not None
        return action

    side.step({0: act()})
    saved, action = side.state(0), act()
    before, hashes = side.hash(0), []
    report = side.step({0: action})[0]
    for place, slot in ((side, 0), (side, 1), (other, 2)):
        place.restore(slot, saved)
        assert place.hash(slot) == before
        again = place.step({slot: action})[slot]
        assert (again.outcome, again.seconds) == (report.outcome, report.seconds)
        assert all(map(np.array_equal, again.joints, report.joints))
        episode = place.episodes[slot]
        assert len(episode.actions) == 2 and episode.sim_seconds > saved.episode.sim_seconds
        images = episode.snapshot.images
        hashes.append((place.hash(slot), place.score(slot), images.color.tobytes()))
    assert len(set(hashes)) == 1 and hashes[0][0] != before
    assert len(saved.episode.actions) == 1, "a saved state stays as it is"


def test_states_that_do_not_fit_are_refused() -> None:
    side = worlds(RING, 2)
    side.reset({0: 1})
    state = side.state(0)
    for other in (worlds(BLOCK, 2), worlds("cable-shape", 1), Worlds(RING, precision="float64")):
        with pytest.raises(InputError, match="does not fit"):
            other.restore(0, state)
    with pytest.raises(InputError, match="another robot"):
        Worlds(RING, robot="panda").restore(0, state)
    with pytest.raises(InputError, match="slot 5"):
        side.restore(5, state)


# -- names


@pytest.mark.parametrize("bad", ["", "oracle", "Planner"])
def test_an_unknown_demonstrator_is_named_with_the_choices(bad: str) -> None:
    assert list(DEMONSTRATORS) == ["scripted", "visible", "mpc", "planner"]
    with pytest.raises(InputError, match=f"no demonstrator '{bad}'; there are: scripted, visible"):
        demonstrator(bad)


def test_the_command_refuses_an_unknown_demonstrator(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", RING, "--out", "x", "--demonstrator", "oracle"]) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert all(name in said.err for name in DEMONSTRATORS)


def test_constructed_goals_take_no_demonstrator(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["goals", LINE, "--out", "x", "--kind", "constructed", "--demonstrator", "mpc"]
    assert main(arguments) == 2
    assert "constructed goals need no demonstrator" in capsys.readouterr().err


# -- acting


@pytest.mark.parametrize("name", [RING, "cable-shape"])
def test_visible_picks_what_the_tip_meets(name: str) -> None:
    side, seeds = worlds(name, 20), list(range(20))
    runs = runs_of(side, seeds)
    differ = 0
    scripted, visible = (
        demonstrator(who)(side, runs_of(side, seeds)) for who in ("scripted", "visible")
    )
    for slot in runs:
        action, snapshot = visible[slot], side.episodes[slot].snapshot
        assert action is not None
        met = met_particle(action[:2], snapshot, side.task.primitive)
        assert met is not None
        # the bead that is met is the one that the action was made for
        near = np.linalg.norm(snapshot.particle_q[:, :2] - action[:2], axis=1)
        assert near[met] <= side.task.cable.visual_radius
        if name == RING:
            assert np.array_equal(snapshot.particle_q[met, :2], action[:2])
        differ += not np.array_equal(action, scripted[slot])
    assert (differ > 0) == (name == RING), "scripted cable-shape picks visible beads anyway"


def test_mpc_has_the_same_bits_in_any_company_and_order() -> None:
    seeds = [0, 1, 2, 3, 4]
    alone = played(Worlds(LINE, 1), seeds, "mpc")
    lanes = played(worlds(LINE, 8), seeds[::-1], "mpc")
    for seed in seeds:
        assert lanes[seed].ended == alone[seed].ended == SOLVED
        assert lanes[seed].rows == alone[seed].rows
        assert np.array_equal(lanes[seed].actions, alone[seed].actions)


def test_mpc_leaves_what_it_looks_ahead_from_untouched() -> None:
    side = worlds(RING, 2)
    runs = runs_of(side, [5, 6])
    before = [(side.hash(i), side.episodes[i].tip.copy()) for i in runs]
    demonstrator("mpc")(side, runs)
    for i, (state, tip) in enumerate(before):
        assert side.hash(i) == state and np.array_equal(side.episodes[i].tip, tip)
        assert len(side.episodes[i].actions) == 0 and side.episodes[i].physics_ok


@pytest.mark.parametrize("name", [RING, "cable-shape"])
def test_mpc_needs_fewer_actions_than_the_script(name: str) -> None:
    seeds, needed = list(range(200, 212)), {}
    for who in ("scripted", "mpc"):
        runs = played(worlds(name, 8), seeds, who)
        assert sum(run.ended == SOLVED for run in runs.values()) >= len(seeds) - 1
        needed[who] = sum(len(run.actions) for run in runs.values())
    assert needed["mpc"] < needed["scripted"]


def test_mpc_takes_the_best_outcome_and_the_first_of_equals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    side = worlds(LINE, 2)
    runs = runs_of(side, [1])
    proposed = [np.array([0.5, 0.01 * i, 0, 0.5, 0.2, 0, 0.04]) for i in range(CANDIDATES)]
    monkeypatch.setattr(side.task, "candidates", lambda *_: proposed, raising=False)

    def choose(ranks: list[tuple[int, float]]) -> int:
        class Told:
            def try_each(self, jobs: list[Any]) -> list[Outlook]:
                pairs = zip(jobs, ranks if jobs else [], strict=True)
                return [Outlook(action, *rank, 0.0, None) for (_, action), rank in pairs]

        monkeypatch.setattr(demonstrating, "_lookahead", lambda worlds: Told())
        action = demonstrator("mpc")(side, runs)[0]
        return next(i for i, one in enumerate(proposed) if np.array_equal(one, action))

    worst = (0, 0.0)
    assert choose([worst] * 7 + [(1, -9.0)]) == 7
    assert choose([(1, 9.0), (2, 0.1), (2, 0.3), (2, 0.3), *[worst] * 4]) == 2
    assert choose([(2, 9.0), (3, 0.1), *[worst] * 6]) == 1
    assert choose([(3, 9.0), (4, 0.1), *[worst] * 6]) == 1
    assert choose([worst] * 8) == 0


def test_candidates_are_different_allowed_and_at_most_eight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    side = worlds(LINE, 2)
    runs = runs_of(side, [1])
    inside = np.array([0.5, 0.0, 0, 0.5, 0.2, 0, 0.04])
    outside = inside * [1, 1, 1, 2, 1, 1, 1]
    many = [np.add(inside, [0, 0.01 * i, 0, 0, 0, 0, 0]) for i in range(20)]
    for proposed, expected in (([inside, outside, inside.copy()], 1), (many, CANDIDATES), ([], 0)):
        monkeypatch.setattr(side.task, "candidates", lambda *_, p=proposed: p, raising=False)
        assert len(demonstrating._candidates(side, 0, runs[0], CANDIDATES)) == expected
    assert demonstrator("mpc")(side, runs) == {0: None}


# -- where they are used


def test_collections_say_who_demonstrated_and_replay(tmp_path) -> None:
    plain = {"task": LINE, "episodes": 2, "workers": 1}
    report = collect(CollectConfig(out=tmp_path / "mpc", demonstrator="mpc", **plain))
    assert report.successes == 2
    assert {info.demonstrator for info in EpisodeReader(tmp_path / "mpc").infos()} == {"mpc"}
    assert verify(tmp_path / "mpc", workers=1)["mismatches"] == 0
    with pytest.raises(InputError, match="demonstrator is mpc there and visible here"):
        collect(CollectConfig(out=tmp_path / "mpc", demonstrator="visible", **plain))


def test_environments_demonstrate_by_name() -> None:
    env = PickPlaceEnv(LINE)
    envs = gymnasium.make_vec("WarpDeform/CableLineNotarget-v2", num_envs=2)
    _, info = env.reset(seed=4)
    envs.reset(seed=[4, 9])
    scripted = env.demonstrate()
    env.reset(seed=4)
    assert np.array_equal(env.demonstrate("scripted"), scripted)
    with pytest.raises(InputError, match="no demonstrator 'oracle'"):
        env.demonstrate("oracle")
    env.reset(seed=4)
    terminated = False
    while not terminated:
        action, both = env.demonstrate("mpc"), envs.unwrapped.demonstrate("mpc")
        assert np.array_equal(both[0], action)
        *_, terminated, _, info = env.step(action)
        # the other episode may be over before: then its action is ignored
        envs.step(np.stack([action if other is None else other for other in both]))
    assert info["success"] and info["actions"] <= 4
    assert envs.unwrapped.demonstrate("mpc")[0] is None, "its episode is over"
