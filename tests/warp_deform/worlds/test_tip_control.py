"""Tips led at 20 Hz: what they take, what is saved of them, and whole actions before and after."""

from __future__ import annotations

import numpy as np
import pytest

from warp_deform.errors import InputError
from warp_deform.worlds import TipControl, Worlds
from warp_deform.worlds.tip_control import nearest_grasp


@pytest.fixture(scope="module")
def fabrics() -> Worlds:
    worlds = Worlds("fabric-flat-notarget", 3, lanes=8)
    worlds.reset({0: 0, 1: 1, 2: 2})
    return worlds


def over(worlds: Worlds, slot: int, particle: int, above: float = 0.004) -> np.ndarray:
    """A tip (4,) above a particle."""
    return np.array([*np.add(worlds.solver.particle_q(slot)[particle], (0, 0, above)), 0.7])


def hashes(worlds: Worlds) -> list[str]:
    for slot in range(worlds.count):
        worlds.look(slot)
    return [worlds.hash(slot) for slot in range(worlds.count)]


def test_a_hold_is_saved_with_its_world_and_ends_with_it(fabrics: Worlds) -> None:
    control = TipControl(fabrics)
    control.begin([0, 2])
    tip = over(fabrics, 0, 9)
    fabrics.episodes[0].tip = tip
    grasp = control.hold(0)
    assert grasp is not None
    assert grasp.particle is not None
    empty = fabrics.episodes[2].tip
    assert control.hold(2) is None  # it waits high above
    seconds = fabrics.episodes[0].sim_seconds
    for _ in range(3):
        tip = np.add(tip, (0.01, 0.005, 0.02, 0.1))
        control.advance({0: tip, 2: empty})
    saved = fabrics.state(0)
    assert saved.run is not None
    assert saved.run.held == (grasp.particle, -1)
    held = np.array(fabrics.solver.particle_q(0)[grasp.particle])
    # what happens to the fabric in another slot is what happens to it here
    fabrics.restore(1, saved)
    assert control.loop.holding([0, 1, 2]).tolist() == [True, True, False]
    for _ in range(3):
        tip = np.add(tip, (0.0, 0.02, -0.01, 0.0))
        control.advance({0: tip, 1: tip})  # slot 2 pauses
    assert hashes(fabrics)[0] == fabrics.hash(1) != fabrics.hash(2)
    moved = fabrics.solver.particle_q(0)[grasp.particle] - held
    assert moved == pytest.approx([0, 0.06, -0.03], abs=1e-5)
    assert fabrics.episodes[0].sim_seconds == pytest.approx(seconds + 0.3)
    assert fabrics.episodes[0].tip == pytest.approx(tip)
    control.let_go(0, release="moving")
    assert not control.loop.holding([0])[0]
    # back in the midst of the hold, once more the same way
    once = fabrics.hash(1)
    fabrics.restore(0, saved)
    tip = saved.episode.tip
    for _ in range(3):
        tip = np.add(tip, (0.0, 0.02, -0.01, 0.0))
        control.advance({0: tip})
    fabrics.look(0)
    assert fabrics.hash(0) == once
    with pytest.raises(InputError, match="slot 0 is under control"):
        fabrics.step({0: np.array([0.5, 0, 0, 0.5, 0.1, 0, 0.1])})
    with pytest.raises(InputError, match="20 Hz"):
        TipControl(fabrics, rate=10.0)
    control.end([0, 1])
    assert not fabrics.episodes[0].at_rest
    assert (fabrics.solver.data.lane("particles.w", 0) > 0).all()
    # a reset, or a state without control, ends it
    fabrics.restore(2, fabrics.state(0))
    assert control.loop.worlds.tolist() == []


def test_control_leaves_what_whole_actions_do_as_it_is(fabrics: Worlds) -> None:
    state = fabrics.state(1)
    assert state.run is None
    x, y = fabrics.solver.particle_q(1)[0][:2]
    action = np.array([x, y, 0.0, x + 0.05, y, 0.0, 0.06])
    fabrics.restore(0, state)
    fabrics.step({0: action})
    once = fabrics.hash(0)
    control = TipControl(fabrics)
    control.begin([1])
    fabrics.episodes[1].tip = over(fabrics, 1, 44)
    assert control.hold(1) is not None
    control.advance({1: np.add(fabrics.episodes[1].tip, (0, 0, 0.05, 0))})
    # beside a world in the midst of a hold, and then in its place
    fabrics.restore(0, state)
    fabrics.step({0: action})
    assert fabrics.hash(0) == once
    fabrics.restore(1, state)
    fabrics.step({1: action})
    assert fabrics.hash(1) == once
    control.begin([1])
    fabrics.reset({1: 4})
    assert control.loop.worlds.tolist() == []


def test_the_nearest_thing_is_taken_from_beside_but_not_from_afar(fabrics: Worlds) -> None:
    episode, config = fabrics.episodes[2], fabrics.task.primitive
    q = np.array(episode.snapshot.particle_q)
    q[:, 2] = 0.004
    q[:, :2] += [5.0, 0.0]
    q[7] = [0.5, 0.0, 0.004]
    body_q = episode.snapshot.body_q

    def taken(*tip: float) -> int | None:
        grasp = nearest_grasp(np.array([*tip, 0.0]), episode.objects, q, body_q, config)
        return None if grasp is None else grasp.particle

    assert taken(0.5, 0.0, 0.01) == 7
    assert taken(0.508, 0.006, 0.01) == 7
    assert taken(0.55, 0.0, 0.01) is None
    assert taken(0.5, 0.0, 0.03) is None
