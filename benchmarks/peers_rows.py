"""Rows of the search over peers' settings: a JSON object a line, appended as they are measured."""

from __future__ import annotations

import json
import platform
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from warp_deform.support.revision import running_revision

__all__ = ["PACKAGES", "RESULTS", "append", "described", "key", "read"]

RESULTS = Path(__file__).parent / "results" / "peers.jsonl"
PACKAGES = {
    "ours": "warp-deform",
    "mujoco": "mujoco",
    "newton-vbd": "newton",
    "newton-xpbd": "newton",
    "pybullet": "pybullet",
}


def described(engine: str, scene: str, settings: Any) -> dict[str, Any]:
    """What a row says of where it comes from."""
    return {
        "engine": engine,
        "scene": scene,
        "settings": {k: v for k, v in asdict(settings).items() if k != "note"},
        "version": _version(PACKAGES[engine]),
        "commit": (running_revision().commit or "")[:12],
        "cpu": processor(),
    }


def key(row: dict[str, Any]) -> str:
    """What two rows of one setting share."""
    settings = json.dumps(row["settings"], sort_keys=True)
    return f"{row['engine']} {row['scene']} {settings}"


def read(path: Path = RESULTS) -> list[dict[str, Any]]:
    """All rows; of a setting measured twice in one way the last."""
    if not path.exists():
        return []
    rows = [json.loads(line) for line in path.read_text().splitlines() if line.strip()]
    return list({(row["kind"], key(row)): row for row in rows}.values())


def append(row: dict[str, Any], path: Path = RESULTS) -> None:
    """Add a row at the end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(row) + "\n")


@cache
def processor() -> str:
    """The processor's name."""
    information = Path("/proc/cpuinfo")
    if information.exists():
        for line in information.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


@cache
def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
