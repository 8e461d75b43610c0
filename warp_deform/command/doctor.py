"""What this machine and this installation offer, and what keeps them from working."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from ..support.extras import install_extra
from ..support.version import __version__
from ..tasks.registry import all_tasks

__all__ = ["DEPENDENCIES", "render", "report"]

DEPENDENCIES = (
    "warp-lang",
    "newton",
    "torch",
    "pytorch-kinematics",
    "trimesh",
    "opencv-python-headless",
    "gymnasium",
    "numpy",
    "scipy",
    "pyarrow",
    "safetensors",
    "joblib",
    "tyro",
    "rich",
    "matplotlib",
    "imageio",
    "imageio-ffmpeg",
)
"""Distributions that the package needs."""


class _Optional(NamedTuple):
    module: str
    distribution: str
    extra: str
    purpose: str


_OPTIONAL = (
    _Optional(
        "pybullet", "pybullet", "dev", "the peer of `warp-deform bench`; Python 3.11 at most"
    ),
    _Optional("ray", "ray", "ray", "collecting on a cluster"),
    _Optional("tensorboard", "tensorboard", "train", "training curves while they grow"),
    _Optional("h5py", "h5py", "export", "export to robomimic"),
    _Optional("websockets", "websockets", "page", "the page of `warp-deform play`"),
    _Optional("panda_py", "panda-python", "panda", "Franka Emika Panda"),
    _Optional("franky", "franky-control", "fr3", "Franka Research 3"),
    _Optional("pyrealsense2", "pyrealsense2", "realsense", "RealSense cameras"),
)

_ROOT = Path(__file__).resolve().parent.parent


def report() -> dict[str, Any]:
    """Examine the machine and the installation.

    Loads Warp, to ask it for its devices, but not torch. `problems` is a list of
    {"problem", "advice"}; `healthy` says that there are none. `warnings` are lines about what works
    but may surprise. Memory and sizes are in GB (1e9 bytes) and MB (1e6 bytes).
    """
    problems = [*_missing(), *_shadowed()]
    warp, warp_problems = _warp()
    ffmpeg, ffmpeg_problems = _ffmpeg()
    problems += [*warp_problems, *ffmpeg_problems]
    return {
        "healthy": not problems,
        "problems": problems,
        "warnings": [*_hiding(), *all_tasks()[1]],
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu_model(),
        "cores": _cores(),
        "memory_gb": _memory_gb(),
        "location": str(_ROOT),
        "versions": {
            "warp-deform": __version__,
            **{name: _version(name) for name in DEPENDENCIES},
        },
        **warp,
        "c_compiler": "not needed: Warp brings its own",
        "ffmpeg": ffmpeg,
        "optional": {
            part.module: {
                "version": _version(part.distribution),
                "purpose": part.purpose,
                "install": install_extra(part.extra),
            }
            for part in _OPTIONAL
        },
    }


def render(report: dict[str, Any]) -> str:
    """A report as text."""
    device = ", ".join(report["devices"]) or "none"
    cuda = "CUDA present" if report["cuda"] else "no CUDA device; not needed"
    cache = report["kernel_cache"]
    lines = [
        f"Python     {report['python']} on {report['platform']}",
        f"CPU        {report['cpu']}, {report['cores']} cores, {report['memory_gb']:.1f} GB",
        f"devices    {device} ({cuda})",
        f"kernels    {cache['path']} ({cache['size_mb']:.1f} MB)",
        f"compiler   {report['c_compiler']}",
        f"ffmpeg     {report['ffmpeg'] or 'missing'}",
        f"package    {report['location']}",
        "",
        *(f"  {name:<24}{version or 'missing'}" for name, version in report["versions"].items()),
        "",
        "optional",
        *(
            f"  {name:<14}{part['version'] or '-':<12}{part['purpose']}"
            + ("" if part["version"] else f"  ({part['install']})")
            for name, part in report["optional"].items()
        ),
        "",
        *(f"warning: {line}" for line in report["warnings"]),
        *(f"problem: {entry['problem']}; {entry['advice']}" for entry in report["problems"]),
    ]
    return "\n".join([*lines, *(["healthy"] if report["healthy"] else [])])


def _version(distribution: str) -> str | None:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def _problem(problem: str, advice: str) -> dict[str, str]:
    return {"problem": problem, "advice": advice}


def _missing() -> Iterator[dict[str, str]]:
    """Dependencies that are not installed, or in a version that this release does not take."""
    for name in DEPENDENCIES:
        if _version(name) is None:
            yield _problem(f"{name} is not installed", f"pip install '{name}'")
    if _version("warp-deform") is None:
        return  # used from its source folder: nothing on record to compare with
    from packaging.requirements import Requirement

    for line in importlib.metadata.requires("warp-deform") or ():
        need = Requirement(line)
        have = _version(need.name)
        if need.marker is None and have is not None and not need.specifier.contains(have, True):
            yield _problem(f"{need.name} {have} does not fit", f"pip install '{need}'")


def _shadowed() -> Iterator[dict[str, str]]:
    """Our other packages, where Python would import something else under their names."""
    for name in ("learning", "hardware"):
        spec = importlib.util.find_spec(name)
        if spec is None:
            yield _problem(f"package {name!r} is not found", "install warp-deform again")
        elif spec.origin is None or Path(spec.origin).resolve().parent != _ROOT / name:
            where = spec.origin or ", ".join(spec.submodule_search_locations or ())
            yield _problem(
                f"{where} hides warp-deform's package {name!r}",
                "rename yours, or take its folder off PYTHONPATH",
            )


def _hiding() -> Iterator[str]:
    """What would hide our packages from a script or `python -m` started in this folder."""
    folder = Path.cwd().resolve()
    if folder == _ROOT:
        return
    for name in ("learning", "hardware", "warp_deform"):
        if (folder / name / "__init__.py").is_file() or (folder / f"{name}.py").is_file():
            yield f"{folder / name} would hide ours from `python -m` and notebooks started here"


def _warp() -> tuple[dict[str, Any], list[dict[str, str]]]:
    """Warp's devices and kernel cache."""
    described: dict[str, Any] = {
        "devices": [],
        "cuda": False,
        "kernel_cache": {"path": None, "size_mb": 0.0},
    }
    try:
        import warp

        warp.init()
    except (ImportError, OSError, RuntimeError) as error:
        return described, [
            _problem(f"Warp does not start: {error}", "pip install --force-reinstall warp-lang")
        ]
    described["devices"] = [f"{device.alias} ({device.name})" for device in warp.get_devices()]
    described["cuda"] = warp.is_cuda_available()
    cache = Path(warp.config.kernel_cache_dir)
    size = sum(file.stat().st_size for file in cache.rglob("*") if file.is_file())
    described["kernel_cache"] = {"path": str(cache), "size_mb": size / 1e6}
    problems = []
    if not warp.is_cpu_available():
        problems.append(
            _problem("Warp has no CPU device", "install a warp-lang wheel for this platform")
        )
    if not os.access(cache, os.W_OK):
        problems.append(
            _problem(
                f"Warp cannot write kernels to {cache}", "set WARP_CACHE_PATH to a folder of yours"
            )
        )
    return described, problems


def _ffmpeg() -> tuple[str | None, list[dict[str, str]]]:
    """The ffmpeg that writes videos."""
    try:
        import imageio_ffmpeg

        return imageio_ffmpeg.get_ffmpeg_exe(), []
    except (ImportError, RuntimeError) as error:
        return None, [_problem(f"no ffmpeg for videos: {error}", "pip install imageio-ffmpeg")]


def _cpu_model() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # not Linux: the standard library's word has to do
    return platform.processor() or platform.machine()


def _cores() -> int:
    """Cores that this process may use, as collecting counts them (affinity and containers too)."""
    import joblib

    return int(joblib.cpu_count())


def _memory_gb() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9
