"""The folder of a control run: what is trained, what snapshots came to, and which one is used.

run.json                      what is trained, the updates planned, and the versions
log.jsonl                     losses, a line every few updates
snapshots/step_*.safetensors  actors, and beside each a JSON file that says whose they are
state.safetensors             all that training goes on from
evaluations/validation_*.json what snapshots came to on validation seeds
control_info.json             the report of `warp-deform eval-control`
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from warp_deform.episodes import versions
from warp_deform.errors import InputError

from ..runs.folder import Fields, RunFolder, check_fields, read_json, write_json

__all__ = ["ControlRun"]

_RESULT: Fields = {"n_episodes": int, "n_success": int, "mean_score": float, "n_guards": int}


class ControlRun(RunFolder):
    """Where a training by gradients keeps its files."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        # `warp-deform report` tables what it finds under the other name
        self.report = self.path / "control_info.json"

    def claim(self, deciding: dict[str, Any], plan: dict[str, Any]) -> str:
        """Write what is trained, unless it stands there; the digest of it.

        Args:
            deciding: settings that a run is known by
            plan: what was made of them; that of the folder holds

        Raises:
            InputError: the folder holds another run.
        """
        wanted = json.loads(json.dumps({**deciding, "versions": versions()}))
        text = json.dumps(wanted, sort_keys=True)
        if self.settings.exists():
            stored = self.read_control()["control"]
            different = next((key for key in wanted if stored.get(key) != wanted[key]), None)
            if different is not None:
                raise InputError(
                    f"{self.path} holds a run with another {different}; choose another --out"
                )
        elif self.state.exists() or self.log.exists() or self.steps():
            raise InputError(
                f"{self.path} holds parts of a run and no {self.settings.name}; choose another "
                "--out"
            )
        else:
            self.create()
            write_json(self.settings, {"control": wanted, "plan": plan})
        return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()

    def read_control(self) -> dict[str, Any]:
        """What `run.json` says: `control`, the settings, and `plan`.

        Raises:
            InputError: this is no control run's folder, or the file is damaged.
        """
        if not self.settings.is_file():
            raise InputError(
                f"{self.path} holds no training run; `warp-deform train-control` makes one with "
                "--out"
            )
        settings = read_json(self.settings)
        if "control" not in settings:
            raise InputError(
                f"{self.path} is no run of `train-control`; use `warp-deform eval {self.path}`"
            )
        what = f"{self.settings} is not what training writes"
        check_fields(settings, {"control": dict, "plan": dict}, what=what)
        deciding: Fields = {"task": str, "method": str, "validate": int, "worlds": int,
                    "horizon": (int, type(None))}  # fmt: skip
        check_fields(settings["control"], deciding, what=what)
        check_fields(settings["plan"], {"updates": int}, what=what)
        return settings

    def validation(self, step: int) -> Path:
        """Where a snapshot's result on validation seeds stands."""
        return self.evaluations / f"validation_{step:08d}.json"

    def validated(self) -> dict[int, dict[str, Any]]:
        """What snapshots came to on validation seeds, by step.

        Raises:
            InputError: a file is damaged.
        """
        results = {}
        for step in self.steps():
            if self.validation(step).is_file():
                results[step] = read_json(self.validation(step))
                what = f"{self.validation(step)} is not what training writes"
                check_fields(results[step], _RESULT, what=what)
        return results

    def write_validation(self, step: int, result: dict[str, Any]) -> None:
        """Keep what a snapshot came to."""
        self.evaluations.mkdir(exist_ok=True)
        write_json(self.validation(step), result)

    def chosen(self) -> int:
        """The step of the best snapshot on validation seeds by its mean score; of equals the last.

        Raises:
            InputError: there is none yet.
        """
        results = self.validated()
        if not results:
            raise InputError(
                f"{self.path} has no snapshot yet; run `warp-deform train-control` to its end"
            )
        return max(results, key=lambda step: (results[step]["mean_score"], step))
