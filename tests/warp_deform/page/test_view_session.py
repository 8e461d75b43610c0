"""Recorded episodes at the page: what is shown is what was recorded, or is said not to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from warp_deform.episodes import EpisodeReader, EpisodeWriter, episode_name
from warp_deform.errors import InputError
from warp_deform.page.play import PlaySession
from warp_deform.page.sources import EpisodeSource
from warp_deform.page.view import MOST_THUMBNAILS, ViewSession
from warp_deform.page.wire import Job, unpack

TASK = "cable-ring"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Seeds 0 and 1 as played, 2 damaged, 4 of a robot."""
    folder = tmp_path_factory.mktemp("kept")
    session = PlaySession(TASK, record=folder)
    for _ in range(2):
        session.do(Job("demonstrate", {"who": "scripted", "whole": True}), lambda *_, **__: None)
        session.do(Job("keep", {}), lambda *_, **__: None)
    (folder / episode_name(2)).write_bytes(b"PAR1 but not much more")
    kept, writer = EpisodeReader(folder).read(0), EpisodeWriter(folder)
    none = [np.zeros((0, n), np.float32) for n in (3, 3, 7, 6)]
    bare = [
        replace(
            step, state_hash="", particle_q=none[0], particle_qd=none[1], body_q=none[2],
            body_qd=none[3], ground_truth=np.zeros(0, np.float32),
        )
        for step in kept.steps
    ]  # fmt: skip
    info = replace(kept.info, seed=4, state_hash="", demonstrator="random", success=False)
    writer.write(replace(kept, info=info, steps=tuple(bare)))
    return folder


@pytest.fixture(scope="module")
def session(folder):
    return ViewSession(EpisodeSource(folder, kind=lambda episode: "other"))


def ask(session, do, **values):
    messages = []
    session.do(Job(do, values), lambda message, everyone=True: messages.append(unpack(message)))
    (message,) = messages
    return message


def test_the_list_names_what_is_there_and_what_is_damaged(session):
    entries = {entry.seed: entry for entry in session.entries}
    assert list(entries) == [0, 1, 2, 4]
    assert entries[0].success and entries[0].who == "human and others" and not entries[0].kind
    assert entries[2].trouble and "episode_000000002" in entries[2].trouble
    assert (entries[4].success, entries[4].kind, entries[4].who) == (False, "other", "random")
    with pytest.raises(InputError, match="episode_000000002"):
        ask(session, "open", key=2, side=0)
    drawn = ask(session, "thumbnails", keys=[0, 2, 3])
    assert "0" in drawn and "2" not in drawn and "3" in drawn
    for keys in ([9], [-1], [0.0], ["0"], [True], [0] * (MOST_THUMBNAILS + 1)):
        with pytest.raises(InputError):
            ask(session, "thumbnails", keys=keys)


def test_it_plays_the_recorded_states(session, folder):
    episode = EpisodeReader(folder).read(1)
    scene = ask(session, "open", key=1, side=0)
    assert scene["same"] is True and scene["count"] == episode.info.actions
    assert np.array_equal(scene["q"], episode.steps[0].particle_q)
    for t in range(scene["count"]):
        clip = ask(session, "clip", key=1, side=0, t=t)
        assert (clip["same"], clip["t"]) == (True, t + 1)
        assert np.array_equal(clip["q"][-1], episode.steps[t + 1].particle_q)
        assert clip["score"] == episode.steps[t + 1].score
    assert clip["last"] and clip["solved"]
    with pytest.raises(InputError, match="actions"):
        ask(session, "clip", key=1, side=0, t=scene["count"])


def test_two_are_compared_and_tabs_do_not_disturb_each_other(session):
    """Clips of both sides in turn, and one that somebody else asks for out of turn."""
    first = [ask(session, "open", key=k, side=side) for side, k in enumerate((0, 1))]
    assert [scene["same"] for scene in first] == [True, True]
    for t in range(2):
        for side, key in enumerate((0, 1)):
            assert ask(session, "clip", key=key, side=side, t=t)["same"] is True
    assert ask(session, "clip", key=0, side=0, t=1)["same"] is True  # again
    assert ask(session, "clip", key=0, side=0, t=2)["same"] is True


def test_another_state_than_the_recorded_one_is_said(session, monkeypatch):
    shown = session.source.show(0)
    wrong = replace(shown, hashes=[shown.hashes[0], "0" * 32, *shown.hashes[2:]])
    monkeypatch.setattr(session.source, "show", lambda key: wrong)
    assert ask(session, "open", key=0, side=1)["same"] is True
    assert ask(session, "clip", key=0, side=1, t=0)["same"] is False
    assert ask(session, "clip", key=0, side=1, t=1)["same"] is True


def test_recordings_of_a_robot_are_pictures(session, folder):
    episode = EpisodeReader(folder).read(4)
    shown = ask(session, "open", key=3, side=0)
    assert shown["kind"] == "pictures" and shown["count"] == episode.info.actions
    assert shown["scores"] == [step.score for step in episode.steps]
    assert all(bytes(shown[f"color{t}"][:4]) == b"\x89PNG" for t in range(len(episode.steps)))
