"""A training run's folder: settings, log, snapshots and the state to go on from.

run.json                     what is trained, on what, and by which versions
log.jsonl                    losses, a line every few steps
snapshots/step_*.safetensors weights, and beside each a JSON file that says whose they are
state.safetensors            all that training goes on from
evaluations/*.json           results of snapshots, episode by episode
goals/                       goals that were made for test episodes
eval_info.json               the report of `warp-deform eval`

Weights are safetensors: loading runs no code.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from warp_deform.errors import InputError, WarpDeformError
from warp_deform.support.whole_file import whole_file

Fields = Mapping[str, type | tuple[type, ...]]
"""Names that a JSON object has to have, and the Python types that their values may be of."""

__all__ = ["TENSORBOARD", "Fields", "RunFolder", "check_fields", "network_settings", "read_json",
           "read_record", "read_snapshot", "write_json"]

TENSORBOARD = "tensorboard"
"""Folder of TensorBoard's files in that of a run."""
_FORMAT = 1
_KINDS = {
    str: "a string", int: "a whole number", bool: "true or false", float: "a number",
    dict: "an object", list: "a list", type(None): "null",
}  # fmt: skip
_AGENT: Fields = {"task": str, "agent": str, "config": dict}
_SETTINGS: Fields = {
    "agent": dict, "preset": str, "schedule": dict, "seed": int, "demonstrations": dict,
}  # fmt: skip
_REPORT: Fields = {
    "task": str, "agent": str, "preset": str, "demos": int, "seed": int, "stage_rule": str,
    "robot": str, "snapshots": dict, "selected": int, "test": (dict, type(None)),
    "paper": (dict, type(None)),
}  # fmt: skip
_NAME = re.compile(r"step_(\d{8})\.safetensors")


class RunFolder:
    """Where a training run keeps its files."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self.settings = self.path / "run.json"
        self.log = self.path / "log.jsonl"
        self.state = self.path / "state.safetensors"
        self.report = self.path / "eval_info.json"
        self.evaluations = self.path / "evaluations"
        self._snapshots = self.path / "snapshots"

    def create(self) -> None:
        """Make the folders.

        Raises:
            InputError: they cannot be made.
        """
        try:
            self._snapshots.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {self.path} cannot be made: {error.strerror}") from error

    @contextlib.contextmanager
    def nothing_by_halves(self) -> Iterator[None]:
        """Where what is done fails before a new run has anything to go on from, none is left.

        A report would list it. After an interruption it stays: the same command goes on.
        """
        new, parents = not self.settings.exists(), (self.path, *self.path.parents)
        missing = [folder for folder in parents if not folder.exists()]
        try:
            yield
        except Exception:
            if new and not self.state.exists() and not self.steps():
                for file in (self.settings, self.log):
                    file.unlink(missing_ok=True)
                shutil.rmtree(self.path / TENSORBOARD, ignore_errors=True)
                for folder in (self._snapshots, *missing):
                    with contextlib.suppress(OSError):  # missing, or holds something else
                        folder.rmdir()
            raise

    def read_settings(self) -> dict[str, Any]:
        """What `run.json` says: agent, preset, schedule, seed, demonstrations and more.

        Raises:
            InputError: this is no training run's folder, or the file is damaged.
        """
        if not self.settings.is_file():
            raise InputError(
                f"{self.path} holds no training run; `warp-deform train` makes one with --out"
            )
        settings, what = read_json(self.settings), f"{self.settings} is not what training writes"
        if "control" in settings:
            raise InputError(
                f"{self.path} is a run of `train-control`; use `warp-deform eval-control {self.path}`"
            )
        check_fields(settings, _SETTINGS, what=what)
        check_fields(settings["agent"], _AGENT, what=what)
        check_fields(settings["schedule"], {"steps": int}, what=what)
        optional = {"validate": int, "trained_steps": int, "versions": dict, "demonstrators": list,
                    "hold_out": int, "revisions": list, "goal": str, "given_goals": int,
                    "goal_seeds": list}  # fmt: skip
        check_fields(settings, {k: v for k, v in optional.items() if k in settings}, what=what)
        check_fields({"patience": None, **settings}, {"patience": (int, type(None))}, what=what)
        if not all(seed.isdecimal() for seed in settings["demonstrations"]):
            raise InputError(f"{what}: a demonstration is not named by its seed")
        return settings

    def read_report(self) -> dict[str, Any]:
        """What `eval_info.json` says, see `evaluation.run.evaluate_run`.

        Raises:
            InputError: the file is missing or damaged.
        """
        report = read_json(self.report)
        what = f"{self.report} is not what this release's `warp-deform eval` writes, evaluate again"
        check_fields(report, _REPORT, what=what)
        return report

    def snapshot(self, step: int) -> Path:
        """Path of the weights after so many steps."""
        return self._snapshots / f"step_{step:08d}.safetensors"

    def steps(self) -> list[int]:
        """Steps of which there are snapshots, in order."""
        matches = (_NAME.fullmatch(path.name) for path in self._snapshots.glob("*.safetensors"))
        return sorted(int(match[1]) for match in matches if match)

    def chosen_snapshot(self) -> Path:
        """The snapshot that the evaluation chose.

        Before there is an evaluation, that of the lowest loss on held-out demonstrations (the
        earliest of equals); without any the last one.

        Raises:
            InputError: there is none, or a file is damaged.
        """
        settings = self.read_settings()
        steps = self.steps()
        if not steps:
            raise InputError(f"{self.path} has no snapshot yet; run `warp-deform train` to its end")
        if not self.report.is_file():
            losses = self.held_out() if settings.get("hold_out") else {}
            return self.snapshot(min(losses, key=losses.__getitem__) if losses else steps[-1])
        chosen = self.read_report()["selected"]
        if chosen not in steps:
            raise InputError(
                f"{self.report} chose step {chosen}, of which there is no snapshot; evaluate again"
            )
        return self.snapshot(chosen)

    def held_out(self) -> dict[int, float]:
        """Loss on held-out demonstrations by step, see `held_out.HeldOut`."""
        records = {step: read_record(self.snapshot(step)) for step in self.steps()}
        return {step: each["held_out"] for step, each in records.items() if "held_out" in each}

    def write_snapshot(
        self, step: int, weights: Mapping[str, Tensor], record: Mapping[str, Any]
    ) -> Path:
        """Store weights, and a record of what they are beside them."""
        path = self.snapshot(step)
        about = {"format": _FORMAT, "step": step, "digest": _digest(weights)}
        write_json(path.with_suffix(".json"), {**about, **record})
        _write_tensors(path, weights)
        return path

    def write_state(self, tensors: Mapping[str, Tensor], step: int, *, key: str) -> None:
        """Store what training goes on from, in place of what was stored before.

        Args:
            key: digest of the settings that it belongs to
        """
        _write_tensors(self.state, tensors, {"format": str(_FORMAT), "step": str(step), "key": key})

    def read_state(self) -> tuple[dict[str, Tensor], int, str]:
        """What `write_state` stored, its step and key; nothing and step 0 at the beginning.

        Raises:
            InputError: it is damaged.
        """
        if not self.state.exists():
            return {}, 0, ""
        tensors, metadata = _read(self.state)
        try:
            return tensors, int(metadata["step"]), metadata["key"]
        except (KeyError, ValueError) as error:
            raise InputError(f"{self.state} is damaged; train into another folder") from error


def read_snapshot(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights of a snapshot, and the record beside them.

    Raises:
        InputError: a file is missing or damaged, or of another format.
    """
    record, (weights, _) = read_record(path), _read(Path(path))
    if record.get("digest", _digest(weights)) != _digest(weights):
        raise InputError(f"{path} is damaged: these are not the weights that were written; copy it or train again")
    return weights, record


def read_record(path: Path) -> dict[str, Any]:
    """The record beside a snapshot's weights: format, step and agent, see `AgentDescription`.

    Raises:
        InputError: a file is missing or damaged, or of another format.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"there is no snapshot {path}; `warp-deform train` makes them")
    beside = path.with_suffix(".json")
    record = read_json(beside)
    if record.get("format") != _FORMAT:
        raise InputError(
            f"{path} has format {record.get('format')!r}; this release reads {_FORMAT}: train again"
        )
    what = f"{beside} is no record of a snapshot"
    check_fields(record, {"step": int, "agent": dict}, what=what)
    optional = {"held_out": 0.0, "digest": ""}
    check_fields({**optional, **record}, {"held_out": float, "digest": str}, what=what)
    check_fields(record["agent"], _AGENT, what=what)
    return record


def check_fields(record: Mapping[str, Any], fields: Fields, *, what: str) -> None:
    """Refuse an object of a JSON file in which a field is missing or of another type.

    `float` takes whole numbers too; `int` takes no booleans, which are numbers in Python alone.

    Raises:
        InputError: it begins with `what`.
    """
    for name, kinds in fields.items():
        if name not in record:
            raise InputError(f"{what}: {name!r} is missing")
        kinds = kinds if isinstance(kinds, tuple) else (kinds,)
        allowed = (*kinds, int) if float in kinds else kinds
        if type(record[name]) not in allowed:
            names = " or ".join(_KINDS[kind] for kind in kinds)
            raise InputError(f"{what}: {name!r} must be {names}")


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object from a file.

    Raises:
        InputError: the file is missing or holds something else.
    """
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no JSON object")
    return content


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a JSON object, whole or not at all."""
    text = json.dumps(record, indent=1, sort_keys=True, allow_nan=False)
    _publish(path, lambda temporary: temporary.write_text(text + "\n", encoding="utf-8"))


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, framework="pt") as file:
            tensors: dict[str, torch.Tensor] = {key: file.get_tensor(key) for key in file.keys()}
            return tensors, file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise InputError(f"{path} is damaged or no safetensors file") from error


def _digest(weights: Mapping[str, Tensor]) -> str:
    """BLAKE2b-128 of names and values."""
    digest = hashlib.blake2b(digest_size=16)
    for name in sorted(weights):
        digest.update(name.encode())
        digest.update(weights[name].reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def network_settings(agent: Mapping[str, Any]) -> dict[str, Any]:
    """What the weights of a described agent's network mean, by name, in JSON types.

    Precision is left out. Descriptions of before `cosines_less_one` do not name it.
    """
    config = {"cosines_less_one": False} | agent["config"]
    return {
        key: list(each) if isinstance(each, tuple) else each
        for key, each in config.items()
        if key != "bfloat16"
    }


def _write_tensors(
    path: Path, tensors: Mapping[str, Tensor], metadata: dict[str, str] | None = None
) -> None:
    """Write tensors, whole or not at all."""

    def write(temporary: Path) -> None:
        save_file({name: each.contiguous() for name, each in tensors.items()}, temporary, metadata)

    _publish(path, write)


def _publish(path: Path, write: Callable[[Path], object]) -> None:
    """Have a file written, whole or not at all."""
    try:
        with whole_file(path) as temporary:
            temporary.touch()
            mode = temporary.stat().st_mode
            write(temporary)
            temporary.chmod(mode)  # safetensors keeps its files from others
    except (OSError, SafetensorError) as error:
        reason = getattr(error, "strerror", None) or error
        raise WarpDeformError(f"{path} cannot be written: {reason}") from error
