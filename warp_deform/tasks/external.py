"""Tasks from outside this package: of installed distributions, and of modules that the user names.

A distribution offers tasks as entry points of the group `warp_deform.tasks`, whose names are the
tasks', followed by `-v2` where the task's version is 2. Names are read from metadata; code is
imported when its task is asked for.
"""

from __future__ import annotations

import importlib
import re
import sys
import traceback
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from ..errors import InputError
from .checking import check_task
from .task import Task

__all__ = ["import_tasks", "load_offered", "offered", "offered_version"]

_GROUP = "warp_deform.tasks"


def offered() -> dict[str, tuple[EntryPoint, ...]]:
    """Entry points of installed distributions by the name of the task; more than one is a clash."""
    points: dict[str, tuple[EntryPoint, ...]] = {}
    for point in entry_points(group=_GROUP):
        name, _ = _parts(point)
        points[name] = (*points.get(name, ()), point)
    return dict(sorted(points.items()))


def offered_version(name: str) -> int:
    """The version that an entry point says, 1 where it says none; nothing is imported."""
    return max((_parts(point)[1] for point in offered().get(name, ())), default=1)


def _parts(point: EntryPoint) -> tuple[str, int]:
    """The name of the task, and its version."""
    match = re.fullmatch(r"(.+?)(?:-v([1-9]\d*))?", point.name)
    return (point.name, 1) if match is None else (match[1], int(match[2] or 1))


def load_offered(name: str) -> type[Task] | None:
    """The task that an installed distribution offers under a name; None where none does.

    Raises:
        InputError: it cannot be imported, is no task or has another name, or several
            distributions offer the name. The message names them.
    """
    points = offered().get(name, ())
    if not points:
        return None
    if len(points) > 1:
        names = " and ".join(sorted(map(_distribution, points)))
        raise InputError(f"{names} both offer a task {name!r}; uninstall one of them")
    (point,) = points
    where = f"the task {name!r} of the distribution {_distribution(point)} ({point.value})"
    try:
        loaded = point.load()
    except (Exception, SystemExit) as error:  # whatever code from elsewhere may raise
        raise InputError(f"{where} cannot be imported: {_said(error)}") from error
    try:
        task = check_task(loaded)
    except InputError as error:
        raise InputError(f"{where} cannot be used: {error}") from error
    if task.name != name:
        raise InputError(f"{where} calls itself {task.name!r}; its entry point must, too")
    if task.version != _parts(point)[1]:
        wanted = name if task.version == 1 else f"{name}-v{task.version}"
        raise InputError(
            f"{where} is of version {task.version}; its entry point must be called {wanted!r}"
        )
    return task


def import_tasks(module: str) -> None:
    """Import a module that the user names, so that it may register its tasks.

    Args:
        module: a dotted name, found as Python finds it or in the present folder, or the path of a
            file that ends with .py. Its folder is added to Python's path, where worker processes
            look, too.

    Raises:
        InputError: there is no such module, or it cannot be imported.
    """
    path = Path(module)
    name, folder = (path.stem, path.parent) if path.suffix == ".py" else (module, Path())
    if path.suffix == ".py" and not path.is_file():
        raise InputError(f"there is no file {module!r} to take tasks from")
    if (added := str(folder.resolve())) not in sys.path:
        sys.path.append(added)
    try:
        imported = importlib.import_module(name)
    except (Exception, SystemExit) as error:  # whatever the user's code may raise
        raise InputError(f"{module} cannot be imported: {_said(error)}") from error
    file = getattr(imported, "__file__", None)
    if path.suffix == ".py" and (file is None or not path.samefile(file)):
        raise InputError(f"{module} is hidden by another module {name!r}, {file}; rename it")


def _distribution(point: EntryPoint) -> str:
    return "unknown" if point.dist is None else point.dist.name


def _said(error: BaseException) -> str:
    """An exception in one line, with the place in the code from elsewhere that raised it."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "importlib" not in frame.filename][1:]
    place = f" ({Path(own[-1].filename).name}, line {own[-1].lineno})" if own else ""
    return f"{type(error).__name__}: {' '.join(str(error).split())}{place}"
