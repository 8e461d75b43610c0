"""Planning: outlooks depend on state and action alone; searches keep to their budget and pay.

Gradients, of bodies and of two actions too, are compared with differences of the same losses.
"""

from dataclasses import replace

import numpy as np
import pytest

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.planning import METHODS, Lookahead, SearchConfig, places, search
from warp_deform.planning.action_pairs import move_both
from warp_deform.planning.action_search import _Around
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.planning.follow import Follow
from warp_deform.planning.gradients import ActionGradients, loss_and_gradients
from warp_deform.planning.places import Places
from warp_deform.planning.waypoints import WaypointConfig, Waypoints, _Bend
from warp_deform.rendering.pixels import SHAPE
from warp_deform.robots.primitive import Outcome
from warp_deform.tasks.registry import task
from warp_deform.worlds import Worlds
from warp_deform.worlds.loop import play

LINE = "cable-line-notarget"
FAR = [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)]


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
    assert len({o.state_value for o in together}) > 3
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
    monkeypatch.setattr(side.task, "state_value", lambda *_: float("nan"), raising=False)
    with pytest.raises(WarpDeformError, match="value of a state is nan"):
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
    searches = []
    for _ in range(2):
        spent = lookahead.rollouts
        rng = np.random.default_rng(5)
        searches.append(search(lookahead, worlds.task, worlds.state(0), rng, config))
        assert 0 < lookahead.rollouts - spent <= 24
    first, second = searches
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
    worlds = Worlds(task(LINE), 8)
    counts = {
        name: [
            len(run.actions)
            for _, run in play(worlds, range(8), act=demonstrator(name), look=lambda *_: None)
        ]
        for name in ("scripted", "planner")
    }
    assert np.sum(counts["planner"]) <= 0.7 * np.sum(counts["scripted"])


def test_a_search_that_cannot_be_is_refused():
    with pytest.raises(InputError, match="no method 'luck'"):
        SearchConfig(method="luck")
    with pytest.raises(InputError, match="must be 1 or more"):
        SearchConfig(budget=0)
    with pytest.raises(InputError, match="depth must be 1 or 2"):
        SearchConfig(depth=3)


def test_given_actions_are_tried_first_and_drawn_ones_say_so(started):
    worlds, lookahead = started
    state = worlds.state(0)
    given = _moves(worlds, 0, 3)[2] + np.array([0, 0, 0, 0.001, 0, 0, 0])
    config = SearchConfig(method="random", depth=1, budget=3, candidates=1)
    rng = np.random.default_rng(2)
    outlooks = search(lookahead, worlds.task, state, rng, config, also=[given, given])
    assert sum(np.array_equal(o.action, given) for o in outlooks) == 1
    if not any(o.solved for o in outlooks):
        assert sorted(o.origin for o in outlooks) == ["candidate", "candidate", "drawn"]
    only = SearchConfig(method="enumerate", depth=1, budget=1, candidates=8)
    (one,) = search(lookahead, worlds.task, state, rng, only, also=[given])
    assert np.array_equal(one.action, given)


def test_what_an_action_that_solves_the_task_leaves_of_a_budget_goes_into_better_ones(started):
    worlds, lookahead = started
    easy = SearchConfig(method="cem", budget=48, candidates=8)
    state, rng = worlds.state(0), np.random.default_rng
    ranks = {}
    solved, worlds.task.success_score = worlds.task.success_score, 0.05
    try:
        for polish in (False, True):
            for depth in (1, 2):
                config, spent = replace(easy, polish=polish, depth=depth), lookahead.rollouts
                tried = search(lookahead, worlds.task, state, rng(0), config)
                assert tried[0].solved
                ranks[polish, depth] = tried[0].rank, lookahead.rollouts - spent
    finally:
        worlds.task.success_score = solved
    for depth in (1, 2):
        (rank, spent), (polished, all_spent) = ranks[False, depth], ranks[True, depth]
        assert polished >= rank and spent < all_spent <= 48
    assert any(ranks[True, depth][0] > ranks[False, depth][0] for depth in (1, 2))


def test_a_slope_that_is_too_chaotic_is_not_used_and_the_origin_says_so(started, monkeypatch):
    worlds, lookahead = started
    config = SearchConfig(method="gradient", depth=1, budget=38, candidates=8)

    def origins():
        rng = np.random.default_rng(0)
        return [o.origin for o in search(lookahead, worlds.task, worlds.state(0), rng, config)]

    monkeypatch.setattr(places, "MOST_GROWTH", np.inf)
    assert sorted(origins()) == ["candidate"] * 8 + ["gradient"] * 6
    monkeypatch.setattr(places, "MOST_GROWTH", 0.0)
    assert sorted(origins()) == ["candidate"] * 8 + ["drawn"] * 6


def test_slopes_are_those_of_the_damped_rollout(started):
    worlds, _ = started
    job = worlds.state(1), _moves(worlds, 1, 1)[0]
    gradients = ActionGradients(worlds.task, robot="ur5", precision="float32")
    (first,), (again,) = gradients.of([job]), gradients.of([job])
    assert first.loss == again.loss and np.array_equal(first.by_place, again.by_place)
    undamped = task(LINE)
    undamped.gradient_damping = None
    (wild,) = ActionGradients(undamped, robot="ur5", precision="float32").of([job])
    assert first.growth < 1e4 and wild.growth > 10 * first.growth


# -- tasks with bodies


@pytest.fixture(scope="module")
def block():
    worlds = Worlds("block-notarget", 2)
    worlds.reset({0: 3, 1: 4})
    return worlds, ActionGradients(worlds.task, robot="ur5", precision="float32")


def _near_miss(worlds):
    """An action that puts the block beside its target, turned."""
    (action,) = _moves(worlds, 0, 1)
    return action + np.array([0, 0, 0, 0.02, -0.03, 0.4, 0])


def test_slopes_of_a_task_with_a_body_are_those_of_differences(block):
    worlds, gradients = block
    state, action = worlds.state(0), _near_miss(worlds)
    computed = gradients.of([(state, action)])[0]
    assert computed.usable and computed.by_place.shape == (4,) and np.isfinite(computed.growth)
    for at, step in zip(range(3, 7), (1e-3, 1e-3, 1e-2, 1e-3), strict=True):
        moved = [action + sign * step * np.eye(7)[at] for sign in (1, -1)]
        plus, minus = gradients.of([(state, m) for m in moved])
        difference = (plus.loss - minus.loss) / (2 * step)
        assert computed.by_place[at - 3] == pytest.approx(difference, abs=2e-3)
    assert np.linalg.norm(computed.by_place[:2]) > 0.9, "as the block goes where it is put"


def test_a_body_is_put_right_by_its_slope(block):
    worlds, _ = block
    lookahead = Lookahead(worlds.task, robot="ur5", precision="float32", count=8)
    config = SearchConfig(method="gradient", steps=12)
    rng, state = np.random.default_rng(0), worlds.state(0)
    around = _Around(lookahead, worlds.task, state, rng, config, keep=False)
    before = lookahead.try_each([(state, _near_miss(worlds))])
    improved = around.improved(before, 60)
    assert [o.origin for o in improved] == ["gradient"] * 12
    assert any(o.solved for o in improved) and not before[0].solved


def test_slopes_of_two_actions_chain_through_the_state_between(block):
    worlds, gradients = block
    state, first = worlds.state(0), _near_miss(worlds)
    follow = Follow.of(worlds.task, state.episode.snapshot, first)
    assert follow is not None and follow.body == 0
    second = replace(follow, like=first + np.array([0, 0, 0, -0.03, 0.01, 0.1, 0]))
    by_first, by_second = gradients.of_pairs([(state, first, second)])[0]
    assert by_first.usable and by_second.usable and by_first.loss == by_second.loss
    for at, step in ((3, 1e-3), (5, 1e-2)):
        both = []
        for change in (step, -step):
            moved = first + change * np.eye(7)[at]
            both.append(gradients.of_pairs([(state, moved, second)])[0][0].loss)
        difference = (both[0] - both[1]) / (2 * step)
        assert by_first.by_place[at - 3] == pytest.approx(difference, abs=5e-3)
    assert abs(by_first.by_place[2]) > 0.01, "a turn that the first makes stays"


def test_losses_are_differentiated_by_particles_and_bodies():
    worlds = Worlds("fabric-cover", 1)
    worlds.reset({0: 0})
    episode = worlds.episodes[0]
    ends = [episode.snapshot.particle_q.astype(float), episode.snapshot.body_q.astype(float)]
    loss, *by = loss_and_gradients(worlds.task, episode, *ends)
    assert [g.shape for g in by] == [x.shape for x in ends] and all(g.any() for g in by)
    for x, g in zip(ends, by, strict=True):
        at, step = np.unravel_index(np.abs(g[..., :2]).argmax(), g[..., :2].shape), 1e-6
        x[at] += step
        moved, _, _ = loss_and_gradients(worlds.task, episode, *ends)
        x[at] -= step
        assert (moved - loss) / step == pytest.approx(g[at], rel=1e-3, abs=1e-5)


def test_moved_lifts_stay_within_their_stage():
    bag = task("bag-items-1")
    moving = Places(task=bag, spread=0.1, turn_spread=0.3, lift_spread=0.2, lifts=True)
    rng = np.random.default_rng(0)
    for stage in bag.stages:
        action = np.array([0.5, 0, 0, 0.5, 0.1, 0, stage.lift])
        drawn = [moving.drawn(action, rng) for _ in range(50)]
        assert {bag.stage_of(d[6]) for d in drawn} == {stage} and len({d[6] for d in drawn}) > 3
        fixed = replace(moving, lifts=False).drawn(action, rng)
        assert fixed[6] == stage.lift


# -- two actions together, and waypoints


def test_two_actions_moved_together_are_tried_as_they_would_run(started):
    worlds, lookahead = started
    state = worlds.state(0)
    config = SearchConfig(method="enumerate", depth=1, budget=8, candidates=8)
    (first,) = lookahead.try_each([(state, _moves(worlds, 0, 1)[0])], keep=True)
    rng = np.random.default_rng(0)
    second = search(lookahead, worlds.task, first.after, rng, config)[0]
    around = Places(task=worlds.task, spread=0, turn_spread=0, lift_spread=0, lifts=False)
    scale = 0.015 * np.array([1, 1, 10, 1])
    pairs = move_both(
        lookahead, worlds.task, state, [(first, second)], around, steps=4, scale=scale
    )
    assert pairs and all(o.origin == p.origin == "gradient" for o, p in pairs)
    best, then = max(pairs, key=lambda pair: pair[1].rank)
    (again,) = lookahead.try_each([(state, best.action)], keep=True)
    (last,) = lookahead.try_each([(again.after, then.action)])
    assert (again.rank, last.rank) == (best.rank, then.rank)
    assert not np.array_equal(then.action[:2], second.action[:2]), (
        "it picks where the first left it"
    )


def test_a_bent_path_is_no_worse_and_runs_again_to_the_same_state(started):
    worlds, _ = started
    jobs = [(worlds.state(s), _moves(worlds, s, 1)[0]) for s in (0, 1)]
    bending = Waypoints(worlds.task, robot="ur5")
    bent = bending.bend(jobs, WaypointConfig(points=4, steps=4))
    assert all(b.after.loss <= b.before.loss for b in bent) and any(b.path for b in bent)
    for slot, one in enumerate(bent):
        state, action = jobs[slot]
        if one.path is not None:
            assert len(one.path.times) >= 7 and one.after.loss < one.before.loss
            ran = bending.run({5: (state, action)}, {5: one.path})
            assert ran[5] == one.after, "neither slot nor neighbours count"
        worlds.restore(slot, state)
        worlds.step({slot: action})
        assert worlds.hash(slot) == one.before.state_hash, "the straight path is the action's"
        worlds.restore(slot, state)


def test_waypoints_chain_through_positions_and_times(started):
    worlds, _ = started
    state, action = worlds.state(0), _moves(worlds, 0, 1)[0]
    base = Waypoints(worlds.task, robot="ur5")._lead({0: (state, action)})[0](action)[1]
    bend = _Bend.of(base, float(action[6]), 3)
    assert bend is not None and len(bend.start) == 11
    rng = np.random.default_rng(0)
    straight = bend.path(bend.start)
    assert straight.times[-1] == pytest.approx(base.times[-1], abs=1e-6)
    values = bend.start + rng.normal(0, 0.01, 11)
    path = bend.path(values)
    by_points, by_times = rng.normal(size=path.positions.shape), rng.normal(size=len(path.times))
    chained = bend.chained(values, by_points, by_times)
    for i in range(11):
        ends = [bend.path(values + sign * 1e-6 * np.eye(11)[i]) for sign in (1, -1)]
        change = (by_points * (ends[0].positions - ends[1].positions)).sum()
        change += by_times @ (ends[0].times - ends[1].times)
        assert chained[i] == pytest.approx(change / 2e-6, rel=1e-5, abs=1e-5)
    # the tip goes as fast as along the straight line
    speed = np.linalg.norm(np.diff(path.positions, axis=0), axis=1)[bend.first : bend.first + 4]
    speed = speed / np.diff(path.times)[bend.first : bend.first + 4]
    assert speed == pytest.approx(worlds.task.stages[0].speed, rel=1e-4)
    flying = bend.limited(values + 5.0)
    assert (flying[:-2].reshape(-1, 3) <= [0.75, 0.5, 0.4]).all()
    assert (
        _Bend.of(replace(base, positions=base.positions * [0, 0, 1]), float(action[6]), 3) is None
    )


@pytest.mark.parametrize("name", ["bag-items-1", "cable-ring", "cable-mask-goal"])
def test_no_place_is_drawn_or_moved_out_of_the_picture(name):
    """An agent over pictures can be taught no place beyond them: `train` refuses such data."""
    moves = Places(task=task(name), spread=0.05, turn_spread=0.0, lift_spread=0.0, lifts=False)
    lift, rng = moves.task.stages[0].lift, np.random.default_rng(0)
    low, high = moves.task.grid.to_world(np.zeros(2)), moves.task.grid.to_world(np.array(SHAPE) - 1)
    for corner in (low, high):
        action = np.array([*corner, 0.0, *corner, 0.0, lift])
        near = [moves.drawn(action, rng) for _ in range(50)]
        far = [moves.moved(action, np.array([dx, dy, 0.0, 0.0]), action) for dx, dy in FAR]
        pixels = moves.task.grid.to_pixel(np.array([each[3:5] for each in near + far]))
        assert ((pixels >= 0) & (pixels < SHAPE)).all()
        assert len(np.unique(pixels, axis=0)) > 10, "and not all at the corner"
