"""Planning: outlooks depend on state and action alone; searches keep to their budget and pay."""

import numpy as np
import pytest

from warp_deform.demonstrators import demonstrator
from warp_deform.episode_loop import play
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.planning import METHODS, Lookahead, SearchConfig, search
from warp_deform.robots.primitive import Outcome
from warp_deform.tasks.registry import task
from warp_deform.worlds import Worlds

LINE = "cable-line-notarget"


@pytest.fixture(scope="module")
def started():
    worlds = Worlds(LINE, 2)
    worlds.reset({0: 3, 1: 4})
    lookahead = Lookahead(worlds.task, robot="ur5", precision="float32", count=16)
    return worlds, lookahead


def _moves(worlds, slot, count):
    episode = worlds.episodes[slot]
    rng = np.random.default_rng(0)
    return worlds.task.candidates(episode.layout, episode.snapshot, rng, count)


def test_an_outlook_depends_on_its_state_and_action_alone(started):
    worlds, lookahead = started
    states = [worlds.state(0), worlds.state(1)]
    before = worlds.hash(0)
    jobs = [(states[s], action) for s in (0, 1) for action in _moves(worlds, s, 6)]
    together = lookahead.try_each(jobs, keep=True)
    backwards = lookahead.try_each(jobs[::-1])[::-1]
    alone = [lookahead.try_each([job])[0] for job in jobs]
    for a, b, c in zip(together, backwards, alone, strict=True):
        assert a.rank == b.rank == c.rank and a.score == b.score == c.score
    assert len({o.promise for o in together}) > 3
    assert worlds.hash(0) == before
    # the state that is kept is the one that the action really leaves
    worlds.step({0: jobs[0][1]})
    assert together[0].after is not None
    moved = np.abs(together[0].after.particle_q - worlds.state(0).particle_q).max()
    assert moved < 1e-3, "but for the shorter wait for rest"
    worlds.restore(0, states[0])


def test_solved_ranks_before_placed_before_idle_before_untrusted(started, monkeypatch):
    worlds, lookahead = started
    job = [(worlds.state(0), _moves(worlds, 0, 1)[0])]
    side = lookahead._worlds

    def rank(outcome):
        return lookahead._outlook(0, job[0][1], outcome, False).rank

    (placed,) = lookahead.try_each(job)
    assert placed.rank == rank(Outcome.PLACED) > rank(Outcome.MISSED) > rank(Outcome.INVALID)
    assert rank(Outcome.MISSED) == rank(Outcome.UNREACHABLE)
    monkeypatch.setattr(side, "solved", lambda slot: True)
    assert rank(Outcome.PLACED) > placed.rank
    monkeypatch.setattr(side.task, "promise", lambda *_: float("nan"), raising=False)
    with pytest.raises(WarpDeformError, match="promise of a state is nan"):
        rank(Outcome.PLACED)


def test_an_action_that_is_not_allowed_moves_nothing(started):
    worlds, lookahead = started
    spent = lookahead.rollouts
    outside = np.array([0.5, 0.0, 0.0, 5.0, 0.2, 0.0, 0.04])
    (outlook,) = lookahead.try_each([(worlds.state(0), outside)])
    assert outlook.grade == 0 and not outlook.solved and lookahead.rollouts == spent


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("depth", [1, 2])
def test_a_search_keeps_to_its_budget_and_repeats_itself(started, method, depth):
    worlds, lookahead = started
    config = SearchConfig(method=method, depth=depth, budget=24, candidates=8)
    found = []
    for _ in range(2):
        spent = lookahead.rollouts
        rng = np.random.default_rng(5)
        found.append(search(lookahead, worlds.task, worlds.state(0), rng, config))
        assert 0 < lookahead.rollouts - spent <= 24
    first, second = found
    assert [o.rank for o in first] == [o.rank for o in second]
    if depth == 1:
        assert [o.rank for o in first] == sorted((o.rank for o in first), reverse=True)


def test_drawing_around_the_best_finds_better_than_the_candidates_alone(started):
    worlds, lookahead = started
    best = {}
    for method in ("enumerate", "cem"):
        config = SearchConfig(method=method, depth=1, budget=48, candidates=16)
        rng = np.random.default_rng(1)
        best[method] = search(lookahead, worlds.task, worlds.state(1), rng, config)[0].rank
    assert best["cem"] > best["enumerate"]


def test_the_planner_needs_fewer_actions_than_the_scripted_demonstrator():
    worlds = Worlds(task(LINE), 4)
    counts = {
        name: [
            len(run.actions)
            for _, run in play(worlds, range(4), act=demonstrator(name), look=lambda *_: None)
        ]
        for name in ("scripted", "planner")
    }
    assert np.sum(counts["planner"]) <= 0.7 * np.sum(counts["scripted"])


def test_a_search_that_cannot_be_is_refused():
    with pytest.raises(InputError, match="no method 'luck'"):
        SearchConfig(method="luck")
    with pytest.raises(InputError, match="must be 1 or more"):
        SearchConfig(budget=0)


def test_given_actions_are_tried_first_and_drawn_ones_say_so(started):
    worlds, lookahead = started
    state = worlds.state(0)
    given = _moves(worlds, 0, 3)[2] + np.array([0, 0, 0, 0.001, 0, 0, 0])
    config = SearchConfig(method="random", depth=1, budget=3, candidates=1)
    rng = np.random.default_rng(2)
    found = search(lookahead, worlds.task, state, rng, config, also=[given, given])
    assert sum(np.array_equal(o.action, given) for o in found) == 1
    if not any(o.solved for o in found):
        assert sorted(o.origin for o in found) == ["candidate", "candidate", "drawn"]
    only = SearchConfig(method="enumerate", depth=1, budget=1, candidates=8)
    (one,) = search(lookahead, worlds.task, state, rng, only, also=[given])
    assert np.array_equal(one.action, given)
