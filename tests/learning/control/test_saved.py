"""An actor that was saved acts as before; what is none is refused in a line."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from learning.control.actor import Actor, PlanActor
from learning.control.saved import load_actor, save_actor
from warp_deform.errors import InputError


def test_a_saved_actor_acts_the_same_to_the_bit(tmp_path: Path) -> None:
    actor, seen = Actor(5, (8, 8)), torch.randn(20, 5)
    actor.norm.update(3.0 * seen + 1.0)
    path = save_actor(tmp_path / "run", actor, task="whip", method="apg", updates=4)
    again, task = load_actor(path)
    assert task == "whip" and torch.equal(again(seen), actor(seen))
    assert sorted(each.name for each in path.parent.iterdir()) == [
        "step_00000004.json", "step_00000004.safetensors"
    ]  # fmt: skip


def test_a_saved_plan_is_the_same_to_the_bit(tmp_path: Path) -> None:
    actor, first = PlanActor(5, (8, 8), steps=7), torch.randn(20, 5)
    first[:, -1] = 0.0
    actor.norm.update(3.0 * first + 1.0)
    again, _ = load_actor(save_actor(tmp_path, actor, task="whip", method="plan", updates=4))
    assert isinstance(again, PlanActor) and torch.equal(again(first), actor(first))


def test_what_is_no_actor_is_refused(tmp_path: Path) -> None:
    path = save_actor(tmp_path, Actor(5, (8,)), task="whip", method="shac", updates=1)
    path.write_bytes(path.read_bytes()[:-8])
    with pytest.raises(InputError, match="damaged"):
        load_actor(path)
    broken = Actor(5, (8,))
    with torch.no_grad():
        broken.network[0].bias.fill_(float("nan"))  # type: ignore[union-attr, operator]
    with pytest.raises(InputError, match="not finite"):
        load_actor(save_actor(tmp_path, broken, task="whip", method="apg", updates=2))
