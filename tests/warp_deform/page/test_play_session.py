"""What is played at the page: actions, undo, reset, guards, and what is kept of it."""

from __future__ import annotations

import gc
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from learning.data.dataset import Demonstrations
from warp_deform.collecting.replay import verify
from warp_deform.envs.env import PickPlaceEnv
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.page.drawing import clip
from warp_deform.page.keeping import HUMAN, MIXED, UNSOLVED, KeptEpisodes
from warp_deform.page.play import PlaySession
from warp_deform.page.wire import Job, unpack
from warp_deform.planning.demonstrators import demonstrator
from warp_deform.rollout.rollouts import Frames
from warp_deform.worlds import tip_step
from warp_deform.worlds.episode import StepReport
from warp_deform.worlds.worlds import Worlds
from warp_deform.xpbd.guards import GuardLimits

TASK = "cable-ring"


@pytest.fixture(scope="module")
def session():
    return PlaySession(TASK, seed=0)


@pytest.fixture
def fresh(session):
    session.reset(0)
    return session


def ask(session, do, *, at=-1, **values):
    """What a page is sent for a job."""
    messages = []
    session.do(Job(do, values, at), lambda message, everyone=True: messages.append(unpack(message)))
    return messages


def act(session, action, **more):
    """A person's message for an action (7,)."""
    pick, place = list(map(float, action[:2])), list(map(float, action[3:5]))
    values = {"pick": pick, "place": place, "turn": float(action[5]), "lift": float(action[6])}
    return ask(session, "act", **values, **more)


def best(session):
    return demonstrator("scripted")(session.worlds, {0: session.run})[0]


def hash_of(session):
    return session.worlds.hash(0)


def test_an_action_is_the_one_of_worlds(fresh):
    alone = Worlds(TASK, 1)
    alone.reset({0: 0})
    action = best(fresh)
    lead, shown = act(fresh, action)
    alone.step({0: action})
    assert shown["hash"] == hash_of(fresh) == alone.hash(0)
    assert shown["score"] == alone.score(0) and shown["acted"] == [HUMAN]
    q = alone.episodes[0].snapshot.particle_q
    assert np.array_equal(shown["q"][-1], q)
    assert len(shown["q"]) == len(shown["links"]) == round(shown["end"] * 30) + 1
    moved = np.abs(shown["q"] - shown["q"][0]).max((1, 2))
    assert moved[0] == 0 < moved[len(moved) // 2] < moved.max()
    first = len(lead["q"]) - 1  # the approach, which is posted before the carry is computed
    assert 0.3 < lead["end"] < shown["end"] and lead["actions"] == shown["actions"]
    assert np.array_equal(lead["q"][:first], shown["q"][:first])
    assert np.array_equal(lead["links"][:first], shown["links"][:first])


def test_the_approach_is_posted_before_the_rest_is_computed(fresh, monkeypatch):
    action, steps = best(fresh), []
    monkeypatch.setattr(tip_step, "carry_and_release", lambda *_: steps.append("carry") or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        fresh.step(action, HUMAN, lambda message, everyone=True: steps.append(unpack(message)))
    lead, carry = steps
    assert lead["kind"] == "lead" and carry == "carry" and np.ptp(lead["links"], axis=0).max() > 0.1


def test_where_nothing_is_taken_the_whole_motion_comes_at_once(fresh):
    action = best(fresh)
    action[:2] = 0.3, -0.45 if fresh.worlds.episodes[0].snapshot.particle_q[0, 1] > 0 else 0.45
    (shown,) = act(fresh, action)
    assert (shown["kind"], shown["outcomes"]) == ("clip", ["missed"])


def test_undo_goes_back_bit_for_bit_and_a_reset_is_that_of_the_environment(fresh):
    hashes = [hash_of(fresh)]
    for _ in range(2):
        act(fresh, best(fresh))
        hashes.append(hash_of(fresh))
    assert len(set(hashes)) == 3
    for expected in hashes[-2::-1]:
        (scene,) = ask(fresh, "undo")
        assert scene["hash"] == expected
    with pytest.raises(InputError, match="nothing to undo"):
        ask(fresh, "undo")
    env = PickPlaceEnv(TASK)
    for seed in (3, 0):
        (scene,) = ask(fresh, "reset", seed=seed)
        assert scene["hash"] == env.reset(seed=seed)[1]["state_hash"]
        assert (scene["seed"], scene["actions"]) == (seed, 0)


@pytest.mark.parametrize("seed", [-5, 10**40, 2**32])
def test_a_seed_that_is_none_moves_nothing(fresh, seed):
    before = hash_of(fresh)
    with pytest.raises(InputError, match="seed"):
        ask(fresh, "reset", seed=seed)
    assert hash_of(fresh) == before


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({0: 0.9}, "pick x"),
        ({4: -0.51}, "place y"),
        ({6: 0.5}, "lift"),
        ({0: np.nan}, "finite"),
        ({3: 0.75, 4: 0.5, 6: 0.4}, "reach"),
    ],
)
def test_what_cannot_be_done_changes_nothing(fresh, changes, says):
    action = best(fresh).copy()
    for at, value in changes.items():
        action[at] = value
    before, version = hash_of(fresh), fresh.head()["version"]
    with pytest.raises(InputError, match=says):
        act(fresh, action)
    assert (hash_of(fresh), fresh.head()["version"]) == (before, version)
    assert fresh.run.actions == fresh.past == fresh.acted == []


def test_who_looked_at_an_older_state_is_told(fresh):
    seen = fresh.head()["version"]
    action = best(fresh)
    act(fresh, action, at=seen)
    after = hash_of(fresh)
    for do in ({"do": "undo"}, {"do": "reset", "seed": 1}):
        with pytest.raises(InputError, match="another tab"):
            ask(fresh, at=seen, **do)
    assert hash_of(fresh) == after


def test_the_pointer_is_told_what_the_tip_would_take(fresh):
    q = fresh.worlds.episodes[0].snapshot.particle_q
    top = int(np.argmax(q[:, 2]))
    (grasp,) = ask(fresh, "probe", xy=[float(q[top, 0]), float(q[top, 1])], turn=0.0)
    met = q[grasp["particle"]]
    assert np.hypot(*(met - q[top])[:2]) < 0.012 and grasp["body"] == -1
    (nothing,) = ask(fresh, "probe", xy=[0.3, -0.45], turn=0.0)
    assert nothing["particle"] == nothing["body"] == -1


def test_a_guard_that_fires_is_told_and_undone(fresh, monkeypatch):
    action, before = best(fresh), hash_of(fresh)
    solver = fresh.worlds.solver
    strict = replace(solver.config, limits=GuardLimits(stretch=1.0001))
    with monkeypatch.context() as patch:
        patch.setattr(solver, "config", strict)
        shown = act(fresh, action)[-1]
    assert "near x" in shown["physics"]
    particles = np.linalg.norm(shown["q"] - np.array(shown["fault"]), axis=-1)
    assert particles.min() < 0.01  # at the middle of a link
    assert "stretch" in shown["physics"] and shown["over"] == "the physics broke"
    assert shown["score"] == 0.0 and not shown["solved"] and "color" not in shown
    with pytest.raises(InputError, match="over"):
        act(fresh, action)
    with pytest.raises(InputError, match="guard"):
        KeptEpisodes.keep(None, fresh.worlds, fresh.run, fresh.acted)
    assert [unpack(message)["kind"] for message in fresh.greet()][:2] == ["hello", "scene"]
    (scene,) = ask(fresh, "undo")
    assert (scene["hash"], scene["physics"], scene["fault"]) == (before, "", None)
    assert len(fresh.run.rows) == 1
    shown = act(fresh, action)[-1]
    assert not shown["physics"] and len(fresh.run.rows) == 2


def test_frames_that_are_not_finite_are_left_out(fresh):
    q = np.repeat(fresh.worlds.episodes[0].snapshot.particle_q[None], 61, axis=0)
    q[40:, 3] = np.nan
    frames = Frames(np.arange(61) / 30, q, np.zeros((61, 0, 7)))
    robot = fresh.worlds.robot
    report = StepReport("invalid", 2.0, (), (), frames)
    snapshot = fresh.worlds.episodes[0].snapshot
    arrays, end = clip(robot, report, robot.home_q, snapshot)
    assert len(arrays["q"]) == 40 and end == pytest.approx(39 / 30)
    q[:] = np.nan
    report = StepReport("invalid", 2.0, (), (), frames)
    assert clip(robot, report, robot.home_q, snapshot) is None


def test_an_episode_of_a_person_is_a_demonstration(tmp_path):
    """Also after an undo, and where a second session goes on."""
    record = tmp_path / "mine"
    first = PlaySession(TASK, record=record)
    assert first.run.seed == 0
    act(first, best(first))
    ask(first, "undo")
    with pytest.raises(InputError, match="nothing has been done"):
        ask(first, "keep")
    while not first.over:
        act(first, best(first))
    scene, note = ask(first, "keep")
    assert (scene["seed"], scene["kept"], scene["actions"]) == (1, 1, 0)
    assert "episode_000000000.parquet" in note["text"]
    ask(first, "demonstrate", who="scripted", whole=True)
    ask(first, "keep")
    act(first, best(first))  # one action solves nothing
    (scene, note) = ask(first, "keep")
    assert scene["kept"] == 2 and UNSOLVED in note["text"]
    act(first, best(first))  # lost with the session, as by a kill

    second = PlaySession(TASK, record=record)
    assert second.run.seed == 3 and second.kept.count == 2
    assert verify(record, workers=1)["mismatches"] == 0
    assert verify(record / UNSOLVED, workers=1)["mismatches"] == 0
    infos = EpisodeReader(record).infos()
    assert [(i.demonstrator, i.success) for i in infos] == [(HUMAN, True), (MIXED, True)]
    assert infos[1].extra["acted"] == ["scripted"] * infos[1].actions
    assert len(Demonstrations(record, task=TASK)) == 2
    with pytest.raises(InputError, match="episodes of cable-ring"):
        KeptEpisodes(record, "block-notarget")


def test_demonstrators_act_step_by_step_or_until_they_are_stopped(fresh):
    work, sight, lead, shown, done = ask(fresh, "demonstrate", who="visible", whole=False)
    assert (work["who"], shown["acted"], done["who"]) == ("visible", ["visible"], "")
    assert lead["kind"] == "lead" and lead["actions"] == shown["actions"] == 1
    assert sight["action"] == shown["action"] and sight["acts"] and "pick" not in sight
    fresh.stop.set()
    assert ask(fresh, "demonstrate", who="visible", whole=True) == []
    fresh.stop.clear()
    with pytest.raises(InputError, match="nobody called 'me'"):
        ask(fresh, "demonstrate", who="me", whole=True)
    ask(fresh, "demonstrate", who="scripted", whole=True)
    assert fresh.over and "solved" in fresh.over


def test_the_gradient_points_where_less_is_left_to_do():
    """A place that is moved along the arrow has a lower loss, by about what is said."""
    session = PlaySession("cable-shape", seed=0)
    action = best(session)
    action[3:5] += (0.03, -0.02)  # away from where the demonstrator places it
    messages = []
    at = {"pick": list(action[:2]), "place": list(action[3:5]), "turn": 0.0, "lift": action[6]}
    before = hash_of(session)
    losses, arrows = [], []
    for _ in range(2):
        messages = ask(session, "gradient", **at)
        [told] = [message for message in messages if message["kind"] == "gradient"]
        losses.append(float(told["says"].split()[3]))
        arrows.append(np.subtract(told["to"], told["place"]))
        at["place"] = list(np.add(told["place"], 0.2 * arrows[-1]))
    assert np.linalg.norm(arrows[0]) == pytest.approx(0.06)
    assert losses[1] < losses[0]
    assert hash_of(session) == before and not session.run.actions
    at["pick"] = [0.3, -0.45] if abs(action[1] + 0.45) > 0.1 else [0.3, 0.45]
    [told] = [m for m in ask(session, "gradient", **at) if m["kind"] == "gradient"]
    assert told["to"] is None and "nothing" in told["says"]


def test_a_hundred_actions_take_no_more_memory_than_twenty(fresh):
    """Actions of several episodes and undone ones: what is kept is the running episode's alone."""

    def act_on(count):
        for number in range(count):
            if fresh.over or number % 10 == 9:
                fresh.reset(number % 3)
            ask(fresh, "demonstrate", who="scripted", whole=False)
            if number % 3 == 0:
                ask(fresh, "undo")

    act_on(20)
    gc.collect()
    before = resident()
    act_on(100)
    gc.collect()
    assert resident() - before < 15 * 2**20


def resident() -> int:
    """Memory of this process [bytes]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def test_fabrics_tell_overlap_and_coverage():
    session = PlaySession("fabric-flat", seed=0)
    before = session.head()
    assert before["measures"]["coverage"] == before["score"] > before["measures"]["overlap"] > 0
    (*_, shown, _) = ask(session, "demonstrate", who="scripted", whole=False)
    assert shown["outcomes"] == ["placed"] and shown["seconds"] > before["seconds"]
    assert set(shown["measures"]) == {"overlap", "coverage"}
    assert shown["measures"]["coverage"] == shown["score"]
