"""Videos of a policy at work: what it saw, where it would pick and place, what it did.

A frame shows, from left to right, the observation with the action drawn into it, the goal where
there is one, and over the observation the heat maps of pick and place: the square root of every
pixel's probability, relative to the most probable one's; of `traced` see `Traced.heat`. Agents that
see the simulator's state have no heat maps; their frames show observation and goal alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from warp_deform.collecting.video import Take, TakeRow, film_takes, seen
from warp_deform.collecting.workers import single_threaded
from warp_deform.episodes import Goal
from warp_deform.errors import InputError, WarpDeformError
from warp_deform.rendering.pixels import PixelGrid
from warp_deform.rendering.video import VideoWriter
from warp_deform.tasks.registry import task as find_task
from warp_deform.worlds.loop import EpisodeRun, worlds_for
from warp_deform.worlds.worlds import Worlds

from ..models.traced import LEVEL, Traced
from ..policy.policy import ImagePolicy, load_policy
from ..runs.folder import RunFolder
from .play import Measures, play_policy
from .protocol import Protocol, goals_for, goals_of
from .summary import Evaluation, PlayedEpisode

__all__ = ["HeatMaps", "Sight", "draw", "film_episodes", "heat_maps"]

_FPS = 10
_HOLD = 15
"""Frames that a state stays in the video; the last one stays twice as long."""
_SCALE = 2
_HEADER, _GAP = 84, 8
_PAPER, _INK, _FAINT = (255, 255, 255), (25, 25, 25), (115, 115, 115)
_PICK, _PLACE, _ARROW = (255, 255, 255), (0, 230, 255), (255, 225, 0)


@dataclass(frozen=True, eq=False)
class HeatMaps:
    """Probabilities (320, 160) float32 of the network pixel that holds each camera pixel.

    Attributes:
        place: given the pick that was taken; of the rotations the most probable
    """

    pick: np.ndarray
    place: np.ndarray


@dataclass(frozen=True, eq=False)
class Sight:
    """What was seen in a state: pictures (320, 160, 3) uint8, and what the network made of them.

    Attributes:
        heat: None in the last state, where nothing is done, and for agents that have none
    """

    color: np.ndarray
    goal: np.ndarray | None
    heat: HeatMaps | None


@torch.no_grad()
def heat_maps(
    policy: ImagePolicy, observation: Mapping[str, np.ndarray], action: np.ndarray
) -> HeatMaps:
    """Where an image policy would pick in what it sees, and place given the pick of `action` (7,).

    What a `RetryingPolicy` avoids is not left out: this is what the network itself says.
    """
    agent = policy.agent
    if isinstance(agent, Traced):
        seen = (np.asarray(observation[name]) for name in ("color", "goal_color"))
        mask, aim = (each[..., 0] > LEVEL for each in seen)
        pick = find_task(policy.description.task).grid.fractional(action[:2])
        return HeatMaps(*agent.heat(mask, aim, pick))
    config, goal = agent.config, None
    if agent.pictures == 2:
        goal = observation["goal_color"], observation["goal_height"]
    image = agent.image((observation["color"], observation["height"]), goal)[None]
    image = image.to(next(agent.parameters()).device)
    grid = find_task(policy.description.task).grid
    pick = torch.from_numpy(config.to_network(grid.to_pixel(action[:2])))[None]
    attention = agent.attention(image).flatten().softmax(0)
    transport = agent.transport(image, pick, n_rotations=config.n_rotations_eval)
    place = transport.flatten().softmax(0).view(-1, *config.shape).amax(0)
    maps = (each.view(config.shape).cpu().numpy() for each in (attention, place))
    return HeatMaps(*(_enlarge(each, config.scale) for each in maps))


def film_episodes(
    run: RunFolder,
    evaluation: Evaluation,
    protocol: Protocol,
    folder: Path,
    *,
    count: int,
    arm: bool = True,
) -> list[Path]:
    """Write MP4s of each of the first `count` episodes of an evaluation; returns their paths.

    `TASK_SEED.mp4` shows heat maps, `TASK_SEED_arm.mp4` the arm at work, as `video.film` shows a
    demonstrator's; the latter is missing where no action was done or the physics failed, and
    without `arm`.
    They are played again, and have to come out as they did.

    Raises:
        InputError: the folder cannot be made or written to, or count is not positive.
        WarpDeformError: an episode comes out differently.
    """
    if count < 1:
        raise InputError(f"{count} videos are asked for; it must be 1 or more")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror}") from error
    policy = load_policy(run.snapshot(evaluation.step))
    task = policy.description.task
    known = {played.seed: played for played in evaluation.episodes[:count]}
    goals = goals_for(run, task, protocol)
    worlds = worlds_for(task, protocol.robot)
    sights: dict[int, list[Sight]] = {}
    hashes: dict[int, list[str]] = {}
    takes: list[Take] = []
    paths = []
    given = None if goals is None else goals_of(goals, protocol, list(known))

    def watch(slot: int, observation: Mapping[str, np.ndarray], action: np.ndarray) -> None:
        images = isinstance(policy, ImagePolicy)
        heat = heat_maps(policy, observation, action) if images else None
        seed = worlds.episodes[slot].seed
        sights.setdefault(seed, []).append(_look(worlds, slot, heat))
        hashes.setdefault(seed, []).append(worlds.hash(slot))

    with single_threaded():
        plays = play_policy(
            policy,
            worlds,
            protocol,
            list(known),
            given,
            watch=watch,
        )
        for slot, played, episode in plays:
            if _essence(played) != _essence(known[played.seed]):
                raise WarpDeformError(
                    f"seed {played.seed} comes out differently here, so its video would show "
                    "something else; evaluate a copy of the run without its evaluations/ here"
                )
            shown = sights.pop(played.seed, [])
            if len(episode.rows) > len(shown):  # else the last state cannot be trusted
                shown.append(_look(worlds, slot, None))
                if arm and episode.actions:
                    states = [*hashes[played.seed], worlds.hash(slot)]
                    goal = None if given is None else given[played.seed]
                    takes.append(_take(worlds, slot, episode, shown, states, goal))
            if shown:
                paths.append(folder / f"{task}_{played.seed}.mp4")
                _write_video(paths[-1], task, played, episode, shown)
    for take in takes:  # not before all are played, as they are simulated in the same worlds
        paths.append(folder / f"{task}_{take.seed}_arm.mp4")
        film_takes([take], paths[-1])
    return sorted(paths)


def _take(
    worlds: Worlds,
    slot: int,
    run: EpisodeRun[Measures],
    sights: Sequence[Sight],
    hashes: Sequence[str],
    goal: Goal | None,
) -> Take:
    """An episode that is over, for a film with the arm."""
    episode = worlds.episodes[slot]
    return Take(
        task=worlds.task.name,
        robot=worlds.robot.name,
        seed=run.seed,
        goal=goal,
        actions=tuple(run.actions),
        rows=tuple(
            TakeRow(state, row.score, seen(sight.color, episode.goal))
            for state, row, sight in zip(hashes, run.rows, sights, strict=True)
        ),
        sim_seconds=episode.sim_seconds,
    )


def draw(
    sight: Sight,
    action: np.ndarray | None,
    lines: tuple[str, str],
    *,
    maps: bool,
    grid: PixelGrid,
) -> np.ndarray:
    """One frame (H, W, 3) uint8.

    Args:
        action: what was done (7,), if anything
        lines: title and state
        maps: whether there is room for heat maps, so that all frames of an episode have one size
        grid: the task's, of the pictures
    """
    plain = _enlarge(sight.color, _SCALE)
    ends = None if action is None else _ends(action, grid)
    panels = {"observation, action": _mark(plain, ends, arrow=True)}
    if sight.goal is not None:
        panels["goal"] = _enlarge(sight.goal, _SCALE)
    if maps:
        heat = sight.heat
        panels["pick"] = _mark(_overlay(plain, heat.pick if heat else None), ends, pick=True)
        panels["place"] = _mark(_overlay(plain, heat.place if heat else None), ends, pick=False)
    rows, columns = plain.shape[:2]
    width = max(len(panels) * (columns + _GAP) + _GAP, 2 * columns)
    frame = np.full((_HEADER + rows + _GAP, width, 3), _PAPER, np.uint8)
    _write(frame, lines[0], (_GAP, 24), 0.62, _INK)
    _write(frame, lines[1], (_GAP, 49), 0.55, _INK)
    for index, (name, panel) in enumerate(panels.items()):
        left = _GAP + index * (columns + _GAP)
        _write(frame, name, (left, _HEADER - 10), 0.45, _FAINT)
        frame[_HEADER : _HEADER + rows, left : left + columns] = panel
    return frame


def _look(worlds: Worlds, slot: int, heat: HeatMaps | None) -> Sight:
    episode = worlds.episodes[slot]
    goal = None if episode.goal is None else episode.goal.color
    return Sight(episode.snapshot.images.color, goal, heat)


def _essence(played: PlayedEpisode) -> tuple[object, ...]:
    """What every release stores of an episode."""
    return played.success, played.score, played.actions


def _write_video(
    path: Path, task: str, played: PlayedEpisode, run: EpisodeRun[Measures], seen: list[Sight]
) -> None:
    total, maps = len(run.actions), any(sight.heat for sight in seen)
    grid = find_task(task).grid
    with VideoWriter(path, _FPS) as video:
        for t, sight in enumerate(seen):
            action = run.actions[t] if t < total else None
            if action is not None:
                doing = f"action {t + 1} of {total}: {run.outcomes[t]}"
            else:
                doing = "solved" if played.success else f"failed: {played.failure}"
            lines = f"{task}, seed {played.seed}", f"score {run.rows[t].score:.3f}   {doing}"
            frame = draw(sight, action, lines, maps=maps, grid=grid)
            for _ in range(_HOLD if action is not None else 2 * _HOLD):
                video.write(frame)


def _overlay(color: np.ndarray, probability: np.ndarray | None) -> np.ndarray:
    """A heat map (320, 160) over a dimmed picture of `_SCALE` times its size."""
    dimmed = color.astype(np.float32) * 0.6
    if probability is None:
        return dimmed.astype(np.uint8)
    # an agent that sees no cable says nothing
    share = np.sqrt(_enlarge(probability, _SCALE) / max(float(probability.max()), 1e-12))
    levels = np.rint(share * 255).astype(np.uint8)
    warm = cv2.cvtColor(cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    weight = np.minimum(1.0, 1.5 * share)[..., None]
    mixed: np.ndarray = np.rint(dimmed * (1 - weight) + warm * weight).astype(np.uint8)
    return mixed


def _ends(action: np.ndarray, grid: PixelGrid) -> list[tuple[int, int]]:
    """Where an action (7,) picks and places: x, y in a picture of `_SCALE` times its size."""
    points = (grid.to_pixel(action[[0, 1, 3, 4]].reshape(2, 2)) + 0.5) * _SCALE
    # far outside of the picture is outside of OpenCV's integers
    return [(int(u), int(v)) for v, u in points.clip(-(2**12), 2**12)]


def _mark(
    picture: np.ndarray,
    ends: list[tuple[int, int]] | None,
    *,
    arrow: bool = False,
    pick: bool = True,
) -> np.ndarray:
    """A copy with an action's arrow from pick to place, or a ring around one of them."""
    picture = picture.copy()
    if ends is None:
        return picture
    # Twice, dark and wide below bright and narrow: the marks show on every background.
    for dark, width in ((True, 3), (False, 1)):
        if arrow:
            ink = _INK if dark else _ARROW
            cv2.arrowedLine(picture, *ends, ink, width, cv2.LINE_AA, tipLength=0.1)
        if arrow or pick:
            cv2.circle(picture, ends[0], 9, _INK if dark else _PICK, width, cv2.LINE_AA)
        if arrow or not pick:
            cv2.circle(picture, ends[1], 9, _INK if dark else _PLACE, width, cv2.LINE_AA)
    return picture


def _enlarge(image: np.ndarray, scale: int) -> np.ndarray:
    """A copy with every pixel repeated `scale` times along both sides."""
    return np.repeat(np.repeat(image, scale, axis=0), scale, axis=1)


def _write(
    frame: np.ndarray, text: str, place: tuple[int, int], size: float, ink: tuple[int, int, int]
) -> None:
    # OpenCV's stroke fonts have ASCII only.
    text = text.encode("ascii", "replace").decode()
    cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, ink, 1, cv2.LINE_AA)
