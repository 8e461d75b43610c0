"""What was evaluated is listed, and comes out again when it is watched."""

from __future__ import annotations

import json
from types import SimpleNamespace as Some

import numpy as np
import pytest
from fixtures.short_runs import SHORT

from learning.page.evaluations import EvaluationSource
from learning.page.kinds import kind_of
from warp_deform.command.main import main
from warp_deform.errors import InputError
from warp_deform.page.view import ViewSession
from warp_deform.page.wire import Job, unpack


def ask(session, do, **values):
    heard = []
    session.do(Job(do, values), lambda message, everyone=True: heard.append(unpack(message)))
    return heard


def test_an_evaluation_is_listed_and_played_again(run):
    with pytest.raises(InputError, match="holds no evaluation"):
        EvaluationSource(run.path)
    assert main(["eval", str(run.path), *SHORT]) == 0
    session = ViewSession(EvaluationSource(run.path))
    assert {entry.group.split(",")[0] for entry in session.entries} == {"test", "validation"}
    entry = next(entry for entry in session.entries if entry.group.startswith("test"))
    assert entry.success or entry.kind
    (drawn,) = ask(session, "thumbnails", keys=[entry.key])
    assert bytes(drawn[str(entry.key)][:4]) == b"\x89PNG" and session.source.at_once == 1
    (opened,) = ask(session, "open", key=entry.key, side=0)
    assert opened["count"] == entry.actions and opened["same"] is None
    while not opened["last"]:
        (opened,) = ask(session, "clip", key=entry.key, side=0, t=opened["t"])
    if entry.actions:  # its picture is that of how it ended
        assert bytes(opened["color"]) == bytes(drawn[str(entry.key)])
    [file] = [f for f in run.evaluations.glob("*.json") if "test" in f.name]
    record = json.loads(file.read_text())
    record["episodes"][0]["score"] += 0.25
    file.write_text(json.dumps(record))
    with pytest.raises(InputError, match="comes out differently"):
        EvaluationSource(run.path).show(entry.key)


def test_kinds_of_failure_by_the_rows_alone():
    def episode(outcomes, actions=(), *, success=False, physics_ok=True):
        steps = [
            Some(outcome=o, action=np.array(a)) for o, a in zip(outcomes, actions, strict=True)
        ]
        steps.append(Some(outcome=None, action=None))
        return Some(info=Some(success=success, physics_ok=physics_ok), steps=steps)

    here, there = (0.4, 0, 0, 0.6, 0, 0, 0.04), (0.6, 0, 0, 0.4, 0, 0, 0.04)
    assert kind_of(episode(["placed"], [here], success=True)) == ""
    assert kind_of(episode(["placed"], [here], physics_ok=False)) == "physics"
    assert kind_of(episode(["missed", "placed"], [here, here])) == "missed grasp"
    assert kind_of(episode(["placed"] * 3, [here, there, here])) == "back and forth"
    assert kind_of(episode(["placed"] * 2, [here, there])) == "other"
