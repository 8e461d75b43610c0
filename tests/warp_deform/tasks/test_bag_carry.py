"""By which bead `visible` carries a bag: the one across it from the items, which then stay in."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from fixtures.bag_episodes import delivered, each_items, snapshot, start

from warp_deform.planning import Lookahead, Outlook
from warp_deform.tasks.bag_items import BagItems1
from warp_deform.tasks.bag_physics import CARRY
from warp_deform.worlds import Worlds
from warp_deform.worlds.episode import DEMONSTRATOR_STREAM, episode_rng
from warp_deform.worlds.loop import SLOTS
from warp_deform.worlds.state import WorldState

pytestmark = pytest.mark.in_a_row("bags")

FIRST = 30_000  # seed, of none that the rule was found or is reported with
ENCLOSED = 4
"""Grade of an outlook that solves the task with every item enclosed."""


@each_items
@pytest.mark.parametrize("angle", np.linspace(-np.pi, np.pi, 5)[:-1])
def test_the_bag_is_carried_by_the_bead_across_it_from_the_items(cls, angle: float) -> None:
    task, layout = start(cls, 2)
    aside = np.array([np.cos(angle), np.sin(angle)])
    done = delivered(task, layout, ())
    body_q = done.body_q.copy()
    body_q[:, :2] = layout.frame[:2] + 0.03 * aside
    state = snapshot(task, layout, done.particle_q, body_q)
    action = task.demonstrate_visible(layout, state, np.random.default_rng(0))
    assert task.stage_of(float(action[6])) is CARRY
    away = action[:2] - layout.frame[:2]
    assert away @ aside < -0.95 * np.linalg.norm(away)
    across = task.across(layout, state)
    rim = task.beads(state)[:, :2] - layout.frame[:2]
    best, worst = rim[across.argmax()], rim[across.argmin()]
    assert best @ aside < 0 < worst @ aside


def test_no_bead_that_is_seen_is_no_carry() -> None:
    task, layout = start(BagItems1, 2)
    done = delivered(task, layout, ())
    done.images.segmentation[:] = 0
    assert task.demonstrate_visible(layout, done, np.random.default_rng(0)) is None


def about_to_carry() -> Iterator[tuple[WorldState, np.ndarray]]:
    """States of episodes of `visible` before their first carry, and that carry."""
    task, side = BagItems1(), Worlds(BagItems1(), SLOTS, lanes=SLOTS)
    seeds = {slot: FIRST + slot for slot in range(SLOTS)}
    side.reset(seeds)
    rngs = {slot: episode_rng(seed, DEMONSTRATOR_STREAM) for slot, seed in seeds.items()}
    for _ in range(task.max_actions):
        actions = {}
        for slot, rng in list(rngs.items()):
            episode = side.episodes[slot]
            action = task.demonstrate_visible(episode.layout, episode.snapshot, rng)
            assert action is not None
            if task.stage_of(float(action[6])) is CARRY:
                yield side.state(slot), action
                del rngs[slot]
            else:
                actions[slot] = action
        if actions:
            side.step(actions)


def test_bags_carried_across_keep_the_cube_and_others_lose_it() -> None:
    task = BagItems1()
    look = Lookahead(task, robot="ur5", precision="float32", count=SLOTS)
    chosen, others = [], []
    for state, action in about_to_carry():
        episode = state.episode
        chosen.append((state, action))
        across = task.across(episode.layout, episode.snapshot)
        worst = min(task.met_beads(episode.snapshot), key=lambda bead: across[bead])
        others.append((state, task._carry_by(episode.layout, episode.snapshot, worst)))

    def kept(outlooks: list[Outlook]) -> int:
        return sum(outlook.grade == ENCLOSED for outlook in outlooks)

    across_kept, near_kept = kept(look.try_each(chosen)), kept(look.try_each(others))
    assert len(chosen) >= 0.75 * SLOTS
    assert across_kept >= 0.75 * len(chosen) and near_kept <= across_kept - 2
