"""Cloning: rows and their chunks, what is seen in play, the ensemble, and the same bits twice."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from learning.control.cloning import (
    ChunkPolicy,
    Chunks,
    Cloner,
    CloningConfig,
    ensembled,
    play_clone,
    read_chunks,
)
from learning.control.features import StateSizes
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.collecting.control_episodes import ControlSetup
from warp_deform.control.numbers import recorded_numbers
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.tasks.registry import task

SEED, CHUNK = 6, 10


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("demos")
    settings = {"task": "block-notarget", "episodes": 2, "seed": SEED, "workers": 1}
    collect(CollectConfig(out=out, control=True, **settings))  # type: ignore[arg-type]
    return out


def test_a_chunk_is_what_followed_and_then_waits(demos: Path) -> None:
    chunks = read_chunks(demos, CHUNK)
    episode = EpisodeReader(demos, control=True).read(SEED)
    actions = np.array([s.action for s in episode.steps if s.action is not None], np.float32)
    last = len(actions) - 1
    assert np.array_equal(chunks.actions[3].numpy(), actions[3 : 3 + CHUNK])
    assert np.array_equal(chunks.actions[last, 0].numpy(), actions[-1])
    waits = chunks.actions[last, 1:]
    assert not waits[:, :-1].any() and (waits[:, -1] == float(actions[-1, -1])).all()
    assert np.array_equal(chunks.seen[: last + 1].numpy(), recorded_numbers(episode)[:-1])


def test_a_policy_sees_in_play_what_was_recorded(demos: Path) -> None:
    chunks = read_chunks(demos, CHUNK)
    recorded = EpisodeReader(demos, control=True).read(SEED).info.actions
    seen = []

    class Told(ChunkPolicy):
        """Says what the demonstrator did next."""

        def forward(self, rows: torch.Tensor) -> torch.Tensor:
            seen.append(rows[0])
            return chunks.actions[len(seen) - 1][None]

    policy = Told(chunks.sizes, CHUNK, chunks.actions.shape[2])
    played = play_clone(chunks.how, policy, [SEED])[SEED]
    assert played.solved and played.steps == recorded
    # the means over chunks that agree differ from them in the last bits
    assert torch.equal(seen[0], chunks.seen[0])
    assert torch.allclose(torch.stack(seen), chunks.seen[:recorded], atol=1e-3)


def test_the_ensemble_weighs_chunks_by_their_age_and_forgets_those_that_are_over() -> None:
    old, new = np.array([[0.0], [1.0]]), np.array([[3.0], [9.0]])
    assert ensembled([old], 0.5) == pytest.approx([0.0])
    share = np.exp(-0.5)
    assert ensembled([old, new], 0.5) == pytest.approx([(1.0 + share * 3.0) / (1.0 + share)])
    assert ensembled([old + 100, old, new], 0.5) == ensembled([old, new], 0.5)


def test_who_is_outvoted_on_holding_does_not_act() -> None:
    """Two that go down empty and one that rises with what it took: the tip goes down."""
    down, rise = np.array([[-0.6, -1.0]] * 3), np.array([[0.5, 1.0]] * 3)
    assert ensembled([down, down, rise], 0.01) == pytest.approx([-0.6, -1.0])
    assert ensembled([rise, down, rise], 0.01) == pytest.approx([0.5, 1.0])


def test_proposals_follow_demonstrators_who_differ() -> None:
    """Half go left and half go right, in the same state: the mean of them would go nowhere."""
    sizes, count = StateSizes(0, 0, ()), 64
    sides = torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0)
    actions = torch.stack([sides, torch.full_like(sides, -1.0)], dim=1)[:, None].repeat(1, 3, 1)
    how = ControlSetup(task("block-notarget").__class__)
    chunks = Chunks(torch.zeros(count, sizes.numbers), actions, sizes, how)
    cloner = Cloner(chunks, CloningConfig(updates=300, batch=64), seed=0)
    for number in range(1, 301):
        cloner.update(number)
    with torch.no_grad():
        chosen = cloner.policy(chunks.seen[:1])[0, :, 0]
    assert chosen.abs().min() > 0.8 and chosen.sign().unique().numel() == 1


def test_training_learns_and_has_the_same_bits_twice(demos: Path) -> None:
    chunks = read_chunks(demos, CHUNK)
    ends, config = [], CloningConfig(updates=60, batch=32)
    for _ in range(2):
        cloner = Cloner(chunks, config, seed=1)
        losses = [cloner.update(number) for number in range(1, 61)]
        assert np.mean(losses[-5:]) < 0.6 * np.mean(losses[:5])
        ends.append([each.clone() for each in cloner.policy.parameters()])
    assert all(torch.equal(a, b) for a, b in zip(*ends, strict=True))


def test_bad_settings_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="chunk"):
        CloningConfig(chunk=0)
    with pytest.raises(InputError):
        read_chunks(tmp_path, CHUNK)
