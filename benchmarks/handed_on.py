"""What the policies handed on in `results/learning/policies` solve: each plays the test seeds.

    python benchmarks/handed_on.py [--policies NAME...] [--episodes N]

Their weights are rounded to bfloat16, and some are older than their task's present version, so what
their run scored is not what they score. Each plays 200 test episodes, and 100 with bags. A policy
that has a row of its task's present version is left out; delete the row to play it again.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import shutil
import tempfile
from pathlib import Path
from typing import Any

from warp_deform.command.main import main as warp_deform
from warp_deform.tasks.registration import env_id
from warp_deform.tasks.registry import task

POLICIES = Path(__file__).parent / "results" / "learning" / "policies"
ROWS = POLICIES.parent / "handed_on.jsonl"


def main() -> None:
    """Play what has no row yet."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    names = sorted(folder.name for folder in POLICIES.iterdir() if folder.is_dir())
    parser.add_argument("--policies", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--episodes", type=int, help="200, and 100 with bags, unless given")
    parser.add_argument("--out", type=Path, default=ROWS)
    options = parser.parse_args()
    rows = read(options.out)
    for name in options.policies:
        asked = json.loads((POLICIES / name / "run.json").read_text())["agent"]["task"]
        if rows.get(name, {}).get("environment") == env_id(asked):
            continue
        episodes = options.episodes or (100 if "bag" in task(asked).objects else 200)
        rows[name] = played(name, episodes)
        print(json.dumps(rows[name]), flush=True)
        lines = [json.dumps(rows[each]) for each in sorted(rows)]
        options.out.write_text("\n".join(lines) + "\n")


def read(path: Path) -> dict[str, dict[str, Any]]:
    """The rows of a file, by the policy's name."""
    lines = path.read_text().splitlines() if path.exists() else []
    return {row["policy"]: row for row in map(json.loads, lines)}


def played(name: str, episodes: int) -> dict[str, Any]:
    """The row of a policy; a copy of its folder plays, since results are kept in it."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / name
        shutil.copytree(POLICIES / name, run)
        command = ["eval", str(run), "--episodes", str(episodes), "--json"]
        # its one snapshot needs no choice
        command += ["--validation-episodes", "1", "--workers", "1"]
        with contextlib.redirect_stdout(io.StringIO()) as out:
            if warp_deform(command):
                raise SystemExit(f"{name} could not be played")
    result = json.loads(out.getvalue().splitlines()[-1])
    test = result["test"]
    low, high = test["pc_success_ci95"]
    return {
        "policy": name, "environment": result["environment"], "agent": result["agent"],
        "demos": result["demos"], "n_success": test["n_success"], "n_episodes": test["n_episodes"],
        "low": low, "high": high, "n_success_enclosed": test["n_success_enclosed"],
        "mean_score": test["mean_score"], "mean_actions": test["mean_actions"],
        "bytes": sum(file.stat().st_size for file in (POLICIES / name).rglob("*.safetensors")),
        "revision": result["revision"],
    }  # fmt: skip


if __name__ == "__main__":
    main()
