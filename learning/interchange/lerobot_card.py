"""The card of a LeRobotDataset: what is in it, for people who find the folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from warp_deform import __version__
from warp_deform.episodes import ControlRecord

__all__ = ["card"]


def card(
    control: ControlRecord,
    features: Mapping[str, Mapping[str, Any]],
    tasks: Sequence[str],
    info: Mapping[str, Any],
) -> str:
    """The text of `README.md`.

    Args:
        features: dtype, shape and names, by column
        info: what `meta/info.json` says
    """
    rows = "\n".join(
        f"| `{name}` | {each['dtype']} {tuple(each['shape'])} | {_names(each['names'])} |"
        for name, each in features.items()
    )
    said = "\n".join(f"- {task}" for task in tasks)
    truth = "" if control.pictures else _TRUTH
    return f"""---
task_categories:
- robotics
tags:
- LeRobot
- deformable objects
configs:
- config_name: default
  data_files: data/*/*.parquet
---

# Demonstrations of warp-deform {__version__}

{info["total_episodes"]} episodes of simulated control with {info["total_frames"]} frames, at
{info["fps"]} Hz, by a {info["robot_type"]}. The format is LeRobotDataset
{info["codebase_version"]}.

{said}

An action has {len(control.names)} numbers from -1 to 1 ({", ".join(control.names)}), in the
control mode `{control.mode}`: an action of length 1 leads the tip at {control.max_speed:g} m/s, a
turn of 1 at {control.max_turn:g} rad/s, and `hold` above 0 takes and keeps. The actions are those
that were executed; taken in `warp_deform.ControlEnv` from the same seed, they give the same states
bit for bit. Seeds and options are in `meta/warp_deform.parquet`.
{truth}
| column | type | numbers |
|---|---|---|
{rows}
"""


_TRUTH = """
`observation.environment_state` is what the simulator knows, which no camera tells: a policy that
reads it sees the truth.
"""


def _names(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 10 else f"{names[0]} to {names[-1]}"
