"""Policies at the page: they act as in an evaluation, and show where they look."""

from __future__ import annotations

import numpy as np
import pytest
from fixtures.places import ROOT

from learning.page.policy_player import PolicyPlayer
from learning.policy.policy import RetryingPolicy, load_policy
from warp_deform.envs.env import PickPlaceEnv
from warp_deform.errors import InputError
from warp_deform.page.play import PlaySession
from warp_deform.page.wire import Job, unpack
from warp_deform.rendering.pixels import world_to_pixel

TASK = "block-notarget"
POLICY = ROOT / "benchmarks/results/learning/policies/block-notarget-goal-split-100"


@pytest.fixture(scope="module")
def session():
    return PlaySession(TASK, seed=10_000, players=[PolicyPlayer(POLICY, task=TASK)])


def ask(session, do, **values):
    messages = []
    session.do(Job(do, values), lambda message, everyone=True: messages.append(unpack(message)))
    return {message["kind"]: message for message in messages}


def test_the_page_shows_where_it_looks_and_nothing_is_done(session):
    session.reset(10_000)
    before, player = session.worlds.hash(0), session.players["goal-split"]
    told = ask(session, "look", who="goal-split")["sight"]
    again = ask(session, "look", who="goal-split")["sight"]
    assert told["action"] == again["action"] and session.worlds.hash(0) == before
    assert told["pick"].tobytes() == again["pick"].tobytes()
    seen = PickPlaceEnv(TASK).reset(seed=10_000)[0]
    action = RetryingPolicy(load_policy(POLICY)).act(seen)
    assert np.array_equal(action, told["action"])
    maps = player.sight(session.worlds, action)
    for probabilities, xy in ((maps.pick, action[:2]), (maps.place, action[3:5])):
        assert probabilities.shape == (320, 160)
        assert probabilities[tuple(world_to_pixel(xy))] == probabilities.max()
    session.players["goal-split"].begin()
    shown = ask(session, "demonstrate", who="goal-split", whole=False)
    assert shown["sight"]["action"] == told["action"] == shown["clip"]["action"]
    assert shown["clip"]["acted"] == ["goal-split"]


def test_it_plays_against_the_person_on_the_same_seed(session):
    session.reset(10_000)
    player = session.players["goal-split"]
    while not session.over:
        ask(session, "demonstrate", who="goal-split", whole=False)
    expected = float(session.worlds.score(0)), len(session.run.actions), session.worlds.solved(0)
    session.reset(10_000)
    before = session.worlds.hash(0), session.head()["version"]
    (row,) = ask(session, "versus", who=player.name)["table"]["rows"]
    assert (row["score"], row["actions"], row["solved"]) == expected
    assert (row["seed"], row["who"]) == (10_000, player.name)
    assert before == (session.worlds.hash(0), session.head()["version"])
    assert session.run.actions == [] == session.past
    scripted = ask(session, "look", who="scripted")["sight"]["action"]
    at = {"pick": scripted[:2], "place": scripted[3:5], "turn": scripted[5], "lift": scripted[6]}
    rows = ask(session, "act", **at)["table"]["rows"]
    assert {row["who"] for row in rows} == {player.name, "you"}
    assert len(session.contest.rows()) == 2


def test_an_agent_over_states_says_that_it_has_no_maps(trained):
    player = PolicyPlayer(trained, task=TASK)
    session = PlaySession(TASK, seed=10_000, players=[player])
    assert not player.looks
    told = {m["kind"]: m for m in map(unpack, session.greet())}["hello"]["players"][0]
    assert told == {"name": "gt-mlp", "looks": False}
    assert player.sight(session.worlds, np.zeros(7)) is None
    with pytest.raises(InputError, match="play that task"):
        PolicyPlayer(trained, task="cable-ring")
