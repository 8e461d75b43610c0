"""Videos of policies: the heat maps are the network's, and the episodes are the evaluated ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest
from fixtures.training_samples import block_episode, write_demonstrations

from learning.evaluation.protocol import Protocol
from learning.evaluation.snapshot import evaluate_snapshot
from learning.evaluation.video import HeatMaps, Sight, draw, film_episodes, heat_maps
from learning.models.transporter import PRESETS
from learning.policy.policy import AgentDescription, ImagePolicy, make_agent
from learning.runs.folder import RunFolder
from learning.training.config import TrainConfig
from learning.training.schedules import Schedule
from learning.training.train import train
from warp_deform.collecting import video as filming
from warp_deform.collecting.workers import single_threaded
from warp_deform.command.main import main
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.rendering.pixels import SHAPE, TABLE_GRID
from warp_deform.tasks.registry import task as find_task

TASK = "block-notarget"


@pytest.fixture(autouse=True, scope="module")
def _one_thread() -> Iterator[None]:
    with single_threaded():
        yield


@pytest.fixture(scope="module")
def run(narrow_networks: None, tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    root = tmp_path_factory.mktemp("film")
    data = write_demonstrations(root / "demos", 1, task=TASK)
    schedule = Schedule(steps=1, batch=1, lr=1e-3, snapshots=1)
    config = TrainConfig(
        task=TASK, agent="goal-stack", data=data, out=root / "run", preset="fast", schedule=schedule
    )
    train(config)
    return RunFolder(root / "run")


@pytest.mark.parametrize(
    ("agent", "task", "rotations"),
    [
        ("transporter", "cable-ring", 1),
        ("goal-split", TASK, 1),
        ("goal-stack", TASK, 4),
        ("goal-split", "cable-mask-goal", 1),
    ],
)
def test_the_maximum_is_where_the_policy_acts(agent: str, task: str, rotations: int) -> None:
    """In the task's own pictures: those of cable-mask-goal show another part of the table.

    With several `picks`, the pick may be another than the most probable one.
    """
    config = replace(PRESETS["fast"], n_rotations_eval=rotations, picks=1)
    description = AgentDescription(task=task, agent=agent, config=vars(config))
    policy = ImagePolicy(make_agent(description, seed=3), description)
    step = block_episode(0, task=TASK).steps[0]
    seen = {"color": step.color, "height": step.height}
    seen |= {"goal_color": step.color[::-1].copy(), "goal_height": step.height}
    action = policy.act(seen)
    heat = heat_maps(policy, seen, action)
    for name, probability, xy in (
        ("pick", heat.pick, action[:2]),
        ("place", heat.place, action[3:5]),
    ):
        assert probability.shape == SHAPE, name
        assert 0 < probability.sum() / config.scale**2 <= 1 + 1e-5, name
        assert probability[tuple(find_task(task).grid.to_pixel(xy))] == probability.max(), name
    assert heat.pick.sum() / config.scale**2 == pytest.approx(1.0, rel=1e-4)


def test_a_frame_shows_the_action_and_the_heat() -> None:
    color = np.full((*SHAPE, 3), 40, np.uint8)
    pick = np.zeros(SHAPE, np.float32)
    pick[100, 60] = 1.0
    sight = Sight(color, color, HeatMaps(pick, pick))
    action = np.array([0.25 + 60 * 0.003125, -0.5 + 100 * 0.003125, 0, 0.6, 0.2, 0, 0.04])
    plain = draw(sight, None, ("a", "b"), maps=True, grid=TABLE_GRID)
    marked = draw(sight, action, ("a", "b"), maps=True, grid=TABLE_GRID)
    assert plain.shape == marked.shape and plain.dtype == np.uint8
    changed = (plain != marked).any(axis=(0, 2))
    panels = [changed[8 + n * 328 : 8 + n * 328 + 320] for n in range(4)]
    assert [bool(panel.any()) for panel in panels] == [True, False, True, True]
    top, left = 84 + 200, 8 + 2 * 328 + 120  # of the hot pixel in the third panel
    assert plain[top, left].max() > 200 and plain[top + 20, left].max() < 60
    far = np.array([1e9, -1e9, 0, 0.6, 0.2, 0, 0.04])  # ground-truth agents are not clamped
    assert draw(sight, far, ("a", "b"), maps=True, grid=TABLE_GRID).shape == plain.shape
    narrow = draw(Sight(color, None, None), None, ("a", "b"), maps=False, grid=TABLE_GRID)
    assert narrow.shape[1] < plain.shape[1]


def test_marks_stand_where_the_task_sees_the_action() -> None:
    grid = find_task("cable-mask-goal").grid
    pick, place = np.array([60, 40]), np.array([250, 120])
    action = np.array([*grid.to_world(pick), 0, *grid.to_world(place), 0, 0.05])
    sight = Sight(np.full((*SHAPE, 3), 40, np.uint8), None, None)
    plain = draw(sight, None, ("a", "b"), maps=True, grid=grid)
    marked = draw(sight, action, ("a", "b"), maps=True, grid=grid)
    for panel, pixel in ((1, pick), (2, place)):  # of pick and of place
        left = 8 + panel * 328
        changed = (plain != marked).any(axis=2)[84 : 84 + 640, left : left + 320]
        middle = np.argwhere(changed).mean(axis=0) / 2 - 0.5
        np.testing.assert_allclose(middle, pixel, atol=0.6)


def test_videos_of_evaluated_episodes(run: RunFolder, tmp_path: Path) -> None:
    arguments = ["eval", str(run.path), "--episodes", "2", "--validation-episodes", "1",
                 "--workers", "1", "--video", str(tmp_path / "films"), "--videos", "1"]  # fmt: skip
    assert main(arguments) == 0
    path, arm = sorted((tmp_path / "films").iterdir())
    assert (path.name, arm.name) == (f"{TASK}_10000.mp4", f"{TASK}_10000_arm.mp4")
    scene = iio.imread(arm)
    assert scene.shape[1:] == (540, 960, 3) and len(scene) > 24
    still = round(filming.STILL_SECONDS * filming.FPS)
    assert np.abs(scene[still + 20].astype(int) - scene[0]).max() > 60  # the arm moves
    frames = list(iio.imiter(path))
    protocol = Protocol(split="test", episodes=2)
    evaluation = evaluate_snapshot(run, 1, protocol)
    assert len(frames) == 15 * evaluation.episodes[0].actions + 30
    assert frames[0].shape == (732, 1320, 3) and frames[0].std() > 10
    with pytest.raises(InputError, match="1 or more"):
        film_episodes(run, evaluation, protocol, tmp_path, count=0)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        film_episodes(run, evaluation, protocol, tmp_path / "file" / "x", count=1)
    wrong = replace(evaluation.episodes[0], actions=evaluation.episodes[0].actions + 1)
    other = replace(evaluation, episodes=(wrong,))
    with pytest.raises(WarpDeformError, match="differently"):
        film_episodes(run, other, protocol, tmp_path / "other", count=1)
    assert not list((tmp_path / "other").iterdir())
