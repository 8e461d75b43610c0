"""Traced: what it foresees, whatever the view; where it acts; that it learns from outcomes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from learning.correction.correct import CorrectConfig, correct
from learning.data.batches import traced_batch
from learning.data.dataset import Demonstrations
from learning.evaluation.protocol import Protocol
from learning.evaluation.snapshot import evaluate_snapshot
from learning.evaluation.video import heat_maps
from learning.models.cable_model import (
    WAYS,
    after_moves,
    moved_points,
    same_way,
    seen_moves,
    turned_over,
    turned_over_points,
)
from learning.models.traced import Traced, TracedConfig, matched_traces
from learning.policy.policy import AgentDescription, ImagePolicy, load_policy
from learning.runs.folder import RunFolder, read_snapshot
from learning.training.config import TrainConfig
from learning.training.train import train
from warp_deform.collecting.collect import CollectConfig, collect
from warp_deform.episodes import EpisodeReader
from warp_deform.errors import InputError
from warp_deform.tasks.cable_mask_goal import CableMaskGoal
from warp_deform.tasks.chain_shapes import curved_chain, tossed_chain
from warp_deform.tasks.strand_trace import trace_strand

TASK = CableMaskGoal()
SMALL = TracedConfig(channels=8, members=2)


def lines(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A tossed cable and a goal, (45, 2) [px] each."""
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
    """Colour and height of a cable (45, 2) [px]."""
    mask = TASK.mask(TASK.grid.to_world(line))
    color = np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
    return color, np.zeros(mask.shape, np.float32)


@pytest.mark.parametrize("seed", range(3))
def test_neither_view_nor_end_nor_mirror_changes_what_it_foresees(seed: int) -> None:
    agent, (now, goal) = Traced(SMALL, seed=seed), lines(seed)
    said = agent.foreseen(now, goal)
    assert said.shape == (SMALL.grips, SMALL.points, 2)
    assert np.linalg.norm(said - now, axis=2).mean() > 0.5, "something moves"
    angle = 0.7 + seed
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moves = {
        "turned and shifted": lambda line: line @ turn + [30.0, -5.0],
        "mirrored": lambda line: line * [1, -1],
    }
    for name, move in moves.items():
        np.testing.assert_allclose(
            agent.foreseen(move(now), move(goal)), move(said), atol=2e-3, err_msg=name
        )
    back = agent.foreseen(now[::-1], goal[::-1])
    np.testing.assert_allclose(back[::-1, ::-1], said, atol=2e-3)
    np.testing.assert_array_equal(SMALL.taken, SMALL.points - 1 - SMALL.taken[::-1])


class Rigid(torch.nn.Module):
    """Foresees that the whole cable goes where the pick goes."""

    def __init__(self) -> None:
        super().__init__()
        self.register_parameter("unused", torch.nn.Parameter(torch.zeros(1)))

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        far = seen[:, 4]  # its way's length
        return torch.stack([far, torch.zeros_like(far)], dim=1)


def test_what_is_foreseen_is_in_pixels_of_the_picture() -> None:
    (now, _), way = lines(3), np.array([12.0, -7.0])
    places = now[SMALL.taken] + way
    many = np.broadcast_to(now, (SMALL.grips, *now.shape))
    after = after_moves([Rigid()], many, now[SMALL.taken], places)
    np.testing.assert_allclose(after, many + way, atol=1e-4)
    still = after_moves([Rigid()], many, now[SMALL.taken], now[SMALL.taken])
    np.testing.assert_allclose(still, many, atol=1e-6)


def knowing() -> Traced:
    """An agent whose model is `Rigid`."""
    agent = Traced(dataclasses.replace(SMALL, members=1), seed=0)
    agent.members = torch.nn.ModuleList([Rigid()])
    return agent


def test_it_takes_what_leads_to_the_goal() -> None:
    """A rigid cable beside its goal, one end astray: any grip but those there solves it."""
    goal = np.column_stack([np.linspace(40, 280, SMALL.points), np.full(SMALL.points, 90.0)])
    now = goal - np.array([0.0, 50.0])
    now[:6, 1] -= np.linspace(40, 0, 6)
    values = knowing().values(now, goal)
    assert values[:2].max() < values[3:].min() and values.max() > 1.0, "solved"
    image = torch.from_numpy(np.stack([picture(each)[0][..., 0] > 127 for each in (now, goal)]))
    action = knowing().act(image[None])
    assert np.linalg.norm(action.place[0] - action.pick[0] - [0.0, 50.0]) < 4.0


def test_a_cable_that_folds_up_is_worth_less_than_one_as_near_that_does_not() -> None:
    goal = np.column_stack([np.linspace(40, 280, SMALL.points), np.full(SMALL.points, 70.0)])
    agent, aim = knowing(), picture(goal)[0][..., 0] > 127
    folded = goal + np.array([0.0, 20.0])
    folded[30:] = folded[29:14:-1] + np.array([0.0, 12.0])  # back beside itself
    off = np.linalg.norm(folded - goal, axis=1).mean()
    beside = goal + np.array([0.0, off])
    for line in (folded, beside):
        assert not (picture(line)[0][..., 0] > 127)[aim].any(), "neither overlaps the goal"
    assert agent._value(folded, goal, aim) < agent._value(beside, goal, aim) - 0.05


def test_an_end_that_is_carried_beyond_the_other_is_still_that_end() -> None:
    """Read from either end the line after it lies about as close; the picked end tells."""
    now = np.column_stack([np.linspace(40, 240, SMALL.points), np.full(SMALL.points, 60.0)])
    for beyond in (0.9, 1.1, 1.3, 1.45):  # of the cable's length, where the end is carried to
        half = np.argmin(np.abs(now[:, 0] - 40 - 100 * beyond))
        after = now.copy()
        # what is left of the fold is drawn over to the right, beside the rest
        after[:half, 0] = 2 * now[half, 0] - now[:half, 0]
        after[:half, 1] += 16.0
        for way in (after, after[::-1]):
            np.testing.assert_array_equal(same_way(now, way, now[0], after[0]), after)
            np.testing.assert_array_equal(
                same_way(now[::-1], way, now[0], after[0]), after[::-1], err_msg="from there"
            )


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


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"grips": 1}, "grips: 2 to 43"),
        ({"grips": 44}, "grips: 2 to 43"),
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
    settings = {"preset": "fast", "steps": 4, "snapshots": 1, "validate": 0}
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
    with pytest.raises(InputError, match="whatever the goal; leave --goal out"):
        config(tmp_path, goal="own")
    with pytest.raises(InputError, match="traced has its own"):
        config(tmp_path, precision="bfloat16")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of four steps on two demonstrations, a third one held out."""
    root = tmp_path_factory.mktemp("traced")
    collect(CollectConfig(task=TASK.name, episodes=3, out=root / "demos", workers=1))
    train(config(root, demos=2, hold_out=1))
    return root


def test_it_learns_what_the_actions_led_to(trained: Path) -> None:
    """As seen, turned back: the picked point goes to its place where it was placed."""
    data = Demonstrations(trained / "demos", task=TASK.name, as_played=True)
    agent = Traced(TracedConfig(), seed=0)
    every = [(e, t) for e, n in enumerate(data.lengths()) for t in range(n)]
    plain, *turned = (
        traced_batch(data, agent, transitions=every, rng=np.random.default_rng(k), augment=k > 0)
        for k in range(4)
    )
    assert plain.seen.shape == (len(every), 8, 45) and plain.moved.shape == (len(every), 2, 45)
    picked = plain.seen[:, 5].argmin(dim=1)
    rows = torch.arange(len(every))
    ahead, aside = plain.moved[rows, :, picked].T
    far = plain.seen[:, 4, 0]
    placed = (ahead - far).hypot(aside) < 0.3  # 15 px, 3 cm
    assert len(every) > 8 and placed.float().mean() > 0.8 and far.max() > 2.0
    found = set()
    for batch in turned:
        for seen, moved, shown, went in zip(*batch, *plain, strict=True):
            ways = [
                way
                for way in WAYS
                if torch.equal(turned_over(shown[None], *way)[0], seen)
                and torch.equal(turned_over_points(went[None], *way)[0], moved)
            ]
            assert len(ways) == 1, "both are turned, and in the same way"
            found.update(ways)
    assert found == set(WAYS)


@pytest.mark.parametrize("way", WAYS)
def test_moves_turned_over_are_those_of_the_cable_turned_over(way: tuple[bool, bool]) -> None:
    mirror, back = way
    (now, goal), rng = lines(4), np.random.default_rng(0)
    after = now + rng.normal(0, 5, now.shape)
    picks, places = now[[9, 30]], goal[[9, 30]]
    both = [np.stack([each, each]) for each in (now, after)]
    seen = torch.from_numpy(seen_moves(both[0], picks, places))
    moved = torch.from_numpy(moved_points(*both, picks, places))
    if mirror:
        both, picks, places = [b * [1, -1] for b in both], picks * [1, -1], places * [1, -1]
    if back:
        both = [b[:, ::-1] for b in both]
    np.testing.assert_allclose(
        turned_over(seen, *way).numpy(), seen_moves(both[0], picks, places), atol=1e-5
    )
    np.testing.assert_allclose(
        turned_over_points(moved, *way).numpy(), moved_points(*both, picks, places), atol=1e-5
    )


def test_outcomes_are_learnt(trained: Path) -> None:
    """Of fresh moves, it foresees where the cable lies better than that nothing moves."""
    data = Demonstrations(trained / "demos", task=TASK.name, as_played=True)
    every = [(e, t) for e, n in enumerate(data.lengths()) for t in range(n)]
    learnt, fresh = every[: -len(every) // 3], every[-len(every) // 3 :]
    agent, rng = Traced(SMALL, seed=1), np.random.default_rng(0)
    optimizer = torch.optim.Adam(agent.parameters(), lr=5e-3)
    for _ in range(150):
        loss = agent(traced_batch(data, agent, transitions=learnt, rng=rng)).total()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    batch = traced_batch(data, agent, transitions=fresh, rng=rng, augment=False)
    assert agent(batch).points < 0.8 * batch.moved.abs().mean()


def test_of_corrected_episodes_it_learns_what_the_policy_did(trained: Path) -> None:
    out = trained / "corrected"
    correct(
        CorrectConfig(
            run=trained / "run", teacher="scripted", episodes=1, out=out, workers=1, seed=900
        )
    )
    played = EpisodeReader(out).read(900)
    data = Demonstrations(out, task=TASK.name, as_played=True)
    episode = data.seeds.index(900)
    assert data.lengths()[episode] == played.info.actions
    for t, step in enumerate(played.steps):
        np.testing.assert_array_equal(data.color(episode, t), step.color)
        if step.action is not None:
            np.testing.assert_array_equal(data.action(episode, t), step.action)
    labels = Demonstrations(out, task=TASK.name)
    assert not np.array_equal(labels.action(episode, 0), data.action(episode, 0))


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


def test_weights_of_another_build_are_refused_with_what_differs(trained: Path) -> None:
    run = RunFolder(trained / "run")
    weights, record = read_snapshot(run.snapshot(4))
    name = "members.0.layers.0.weight"
    weights[name] = torch.zeros(64, 9, 5)  # of the agent that named grips
    other = RunFolder(trained / "other")
    (trained / "other" / "snapshots").mkdir(parents=True)
    other.write_snapshot(4, weights, {"agent": record["agent"]})
    with pytest.raises(InputError, match=rf"of this release's agents: .*{name}"):
        load_policy(other.snapshot(4))
