"""Traced: what it says does not depend on the view; where it acts; that it learns by the cable."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from learning.data.batches import traced_batch
from learning.data.dataset import Demonstrations
from learning.evaluation.protocol import Protocol
from learning.evaluation.snapshot import evaluate_snapshot
from learning.evaluation.video import heat_maps
from learning.models.traced import (
    WAYS,
    Traced,
    TracedBatch,
    TracedConfig,
    features,
    matched_traces,
    turned_over,
)
from learning.policy.policy import AgentDescription, ImagePolicy, load_policy
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.errors import InputError
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import curved_chain, tossed_chain
from warp_deform.tasks.strand_trace import trace_strand

TASK = CableMaskGoal()
SMALL = TracedConfig(channels=8, members=2)


def lines(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A tossed cable and a goal, (91, 2) [px] each."""
    rng = np.random.default_rng(seed)
    now = tossed_chain(rng, TASK.cable, TASK.x, TASK.y)
    goal = curved_chain(rng, TASK.cable, TASK.x, TASK.y, bend=1.0)
    return _points(now), _points(goal)


def _points(beads: np.ndarray) -> np.ndarray:
    """As many points [px] as the agent sees, along beads [m]."""
    at = np.linspace(0, len(beads) - 1, SMALL.points)
    line = np.stack([np.interp(at, np.arange(len(beads)), beads[:, k]) for k in range(2)], axis=1)
    return TASK.grid.fractional(line)


def picture(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colour and height of a cable (91, 2) [px]."""
    mask = TASK.mask(TASK.grid.to_world(line))
    color = np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
    return color, np.zeros(mask.shape, np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_neither_view_nor_end_nor_mirror_changes_what_it_says(seed: int) -> None:
    agent, (now, goal) = Traced(SMALL, seed=seed), lines(seed)
    said = agent.probabilities(now, goal)
    assert said.shape == (SMALL.grips,) and said.sum() == pytest.approx(1.0, abs=1e-6)
    assert np.ptp(said) > 1e-3, "it does tell grips apart"
    angle = 0.7 + seed
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for name, (here, there) in {
        "turned and shifted": (now @ turn + [30.0, -5.0], goal @ turn + [30.0, -5.0]),
        "mirrored": (now * [1, -1], goal * [1, -1]),
    }.items():
        np.testing.assert_allclose(agent.probabilities(here, there), said, atol=1e-5, err_msg=name)
    back = agent.probabilities(now[::-1], goal[::-1])
    np.testing.assert_allclose(back[::-1], said, atol=1e-5)
    np.testing.assert_array_equal(SMALL.taken, SMALL.points - 1 - SMALL.taken[::-1])


@pytest.mark.parametrize("way", WAYS)
def test_features_turned_over_are_those_of_the_cable_turned_over(way: tuple[bool, bool]) -> None:
    mirror, back = way
    now, goal = lines(4)
    shown = turned_over(torch.from_numpy(features(now, goal))[None], mirror, back)[0]
    if mirror:
        now, goal = now * [1, -1], goal * [1, -1]
    if back:
        now, goal = now[::-1], goal[::-1]
    np.testing.assert_allclose(shown.numpy(), features(now, goal), atol=1e-5)


def test_it_picks_on_the_cable_and_places_on_the_goal_where_that_point_belongs() -> None:
    agent = Traced(SMALL, seed=0)
    for seed in range(4):
        now, goal = lines(seed)
        image = agent.image(picture(now), picture(goal))[None]
        action = agent.act(image)
        (mask, aim) = image[0].numpy()
        traces = matched_traces(mask, aim, SMALL.points)
        assert traces is not None
        k = int(np.linalg.norm(traces[0] - action.pick[0], axis=1).argmin())
        assert k in SMALL.taken
        np.testing.assert_array_equal(action.pick[0], traces[0][k])
        np.testing.assert_array_equal(action.place[0], traces[1][k])
        ways = [np.linalg.norm(now - way, axis=1).mean() for way in (goal, goal[::-1])]
        place = (goal, goal[::-1])[int(np.argmin(ways))][
            np.linalg.norm(now - action.pick[0], axis=1).argmin()
        ]
        assert np.linalg.norm(action.place[0] - place) < 6.0, "a centimetre"


def test_what_is_to_be_avoided_is_not_taken_unless_everything_is() -> None:
    agent, (now, goal) = Traced(SMALL, seed=0), lines(1)
    image = agent.image(picture(now), picture(goal))[None]
    rows, columns = np.ogrid[:320, :160]
    avoid, taken = torch.zeros((1, 320, 160), dtype=torch.bool), []
    for _ in range(SMALL.grips):
        pick = agent.act(image, avoid=avoid).pick[0]
        taken.append(tuple(pick))
        avoid[0] |= torch.from_numpy(np.hypot(rows - pick[0], columns - pick[1]) < 3.0)
    assert len(set(taken)) == SMALL.grips
    everywhere = agent.act(image, avoid=torch.ones_like(avoid))
    assert tuple(everywhere.pick[0]) == taken[0], "all are barred: as if none were"


def test_without_a_cable_what_there_is_goes_to_the_middle_of_the_goal() -> None:
    agent = Traced(SMALL, seed=0)
    empty = np.zeros((320, 160, 3), np.uint8), np.zeros((320, 160), np.float32)
    speck = empty[0].copy(), empty[1]
    speck[0][200, 30] = 255
    goal = picture(lines(0)[1])
    middle = trace_strand(goal[0][..., 0] > 127, SMALL.points)
    assert middle is not None
    for current, pick in ((empty, [160, 80]), (speck, [200, 30])):
        action = agent.act(agent.image(current, goal)[None])
        np.testing.assert_array_equal(action.pick[0], pick)
        np.testing.assert_array_equal(action.place[0], middle[SMALL.points // 2])
        masks = (each[0][..., 0] > 127 for each in (current, goal))
        assert not np.any(agent.heat(*masks, np.array(pick)))
    seen = picture(lines(0)[0])
    for current in (empty, seen):
        with pytest.raises(InputError, match="the goal's mask shows no cable"):
            agent.act(agent.image(current, empty)[None])
    with pytest.raises(InputError, match="goal picture"):
        agent.image(seen)


def test_a_rule_of_the_cable_is_learnt() -> None:
    """Of fresh cables, the grip farthest from its place is named six times of ten; chance is one of
    fifteen.
    """
    torch.manual_seed(0)
    agent = Traced(SMALL, seed=1)
    shown = [features(now, min((goal, goal[::-1]), key=lambda g: np.linalg.norm(now - g)))
             for now, goal in map(lines, range(240))]  # fmt: skip
    seen = torch.from_numpy(np.stack(shown))
    farthest = seen[:, 3][:, SMALL.taken].argmax(dim=1)
    optimizer = torch.optim.Adam(agent.parameters(), lr=5e-3)
    for step in range(150):
        rows = torch.from_numpy(np.random.default_rng(step).integers(200, size=32))
        loss = agent(TracedBatch(seen[rows], farthest[rows])).total()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    right = agent.logits(seen[200:]).mean(0).argmax(dim=1) == farthest[200:]
    assert right.float().mean() > 0.6


def test_the_gap_is_that_to_another_strand() -> None:
    straight = np.column_stack([np.linspace(10, 250, SMALL.points), np.full(SMALL.points, 80.0)])
    assert features(straight, straight)[-1] == pytest.approx(np.ones(SMALL.points))
    turn = SMALL.points // 2
    hairpin = straight.copy()
    hairpin[turn:] = straight[turn::-1] + np.array([0, 15])  # back, 15 px beside
    gap = features(hairpin, hairpin)[-1]
    assert gap[:30] == pytest.approx(0.5, abs=0.01) and gap[-30:] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"grips": 1}, "grips: 2 to 87"),
        ({"grips": 88}, "grips: 2 to 87"),
        ({"points": 8}, "points"),
        ({"members": 0}, "members"),
        ({"channels": 0}, "channels"),
        ({"lifts": (0.05, 0.3)}, "lifts: one"),
    ],
)
def test_sizes_are_checked(change: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        dataclasses.replace(TracedConfig(), **change)  # type: ignore[arg-type]


@pytest.mark.parametrize("task", ["cable-line-notarget", "cable-ring", "bag-color-goal"])
def test_it_is_for_masks_of_one_cable(task: str) -> None:
    with pytest.raises(InputError, match="use it on cable-mask-goal"):
        AgentDescription(task=task, agent="traced", config={})


def config(tmp_path: Path, **changes: object) -> TrainConfig:
    settings = {"preset": "fast", "steps": 4, "snapshots": 1, "validate": 0, "goal": "own"}
    return TrainConfig(
        task=TASK.name,
        agent="traced",
        data=tmp_path / "demos",
        out=tmp_path / "run",
        progress=False,
        **{**settings, **changes},  # type: ignore[arg-type]
    )


def test_the_paper_has_no_such_agent(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="use --preset fast"):
        config(tmp_path, preset="paper")
    with pytest.raises(InputError, match="leave --exact out"):
        config(tmp_path, exact=True)
    with pytest.raises(InputError, match="traced has its own"):
        config(tmp_path, precision="bfloat16")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four steps on two demonstrations, a third one held out."""
    root = tmp_path_factory.mktemp("traced")
    collect(CollectConfig(task=TASK.name, episodes=3, out=root / "demos", workers=1))
    train(config(root, demos=2, hold_out=1))
    return root


def test_labels_are_the_grips_that_were_taken(trained: Path) -> None:
    """The script takes five beads; read from the other end, a label counts from there."""
    data = Demonstrations(trained / "demos", task=TASK.name, goal="own")
    agent = Traced(TracedConfig(), seed=0)
    every = [(e, t) for e, n in enumerate(data.lengths()) for t in range(n)]
    batches = [
        traced_batch(data, agent, transitions=every, rng=np.random.default_rng(k), augment=k > 0)
        for k in range(4)
    ]
    plain = batches[0]
    five = {0, 3, 4, 7, 10, 11, 14}  # nearest to beads 2, 23, 44, 66 and 87, as the trace has them
    assert set(plain.grip.tolist()) <= five and len(every) > 4
    for batch in batches[1:]:
        for seen, grip, shown, label in zip(batch.features, batch.grip, *plain, strict=True):
            fits = [
                way
                for way in WAYS
                if torch.equal(turned_over(shown[None], *way)[0], seen)
                and int(grip) == (14 - int(label) if way[1] else int(label))
            ]
            assert fits


def test_a_run_trains_is_evaluated_and_acts(trained: Path) -> None:
    run = RunFolder(trained / "run")
    assert run.steps() == [4] and run.held_out()[4] > 0
    policy = load_policy(trained / "run")
    assert isinstance(policy, ImagePolicy) and policy.description.agent == "traced"
    played = evaluate_snapshot(run, 4, Protocol(split="validation", episodes=1))
    assert played.episodes[0].actions >= 1
    now, goal = lines(2)
    seen = dict(zip(("color", "height"), picture(now), strict=True))
    aim = dict(zip(("color", "height"), picture(goal), strict=True))
    action = policy.act(seen, aim)
    assert np.linalg.norm(TASK.grid.to_world(now) - action[:2], axis=1).min() < 0.004
    assert np.linalg.norm(TASK.grid.to_world(goal) - action[3:5], axis=1).min() < 0.004
    assert action[6] == TASK.stages[0].lift
    observed = {**seen, **{f"goal_{name}": each for name, each in aim.items()}}
    heat = heat_maps(policy, observed, action)
    for shown, xy in ((heat.pick, action[:2]), (heat.place, action[3:5])):
        assert shown[tuple(TASK.grid.to_pixel(xy))] == shown.max() > 0
    near = [(action[:2], 0.01)]
    assert np.linalg.norm(policy.act(seen, aim, avoid=near)[:2] - action[:2]) > 0.01
