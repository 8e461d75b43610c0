"""The documentation site builds without a warning, and shows every public name."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace

import pytest
from fixtures.places import ROOT

EVERY_PACKAGE = ["warp_deform", "warp_deform.objects", "warp_deform.solver", "warp_deform.rollout",
                 "warp_deform.worlds", "warp_deform.episodes", "warp_deform.planning",
                 "warp_deform.robots", "warp_deform.gradcheck", "warp_deform.control", "hardware",
                 "hardware.emulator"]  # fmt: skip

needs_mkdocs = pytest.mark.skipif(
    any(importlib.util.find_spec(name) is None for name in ("material", "mkdocstrings_handlers")),
    reason="mkdocs-material and mkdocstrings are not installed: pip install -e '.[docs]'",
)


def build(config: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """Build the site of a configuration strictly."""
    return subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict",
         "--config-file", str(config), "--site-dir", str(site)],
        cwd=config.parent, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True, text=True, timeout=240,
    )  # fmt: skip


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = build(ROOT / "mkdocs.yml", folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder


@needs_mkdocs
@pytest.mark.parametrize("package", EVERY_PACKAGE)
def test_every_public_name_is_shown(site: Path, package: str) -> None:
    """What a package lists in `__all__`, lazy names included."""
    inventory = (site / "objects.inv").read_bytes().split(b"\n", 4)[4]
    shown = {line.split(" ")[0] for line in zlib.decompress(inventory).decode().splitlines()}
    public = set(importlib.import_module(package).__all__) - {"__version__"}
    missing = {name for name in public if f"{package}.{name}" not in shown}
    assert public and missing == set()


@needs_mkdocs
def test_pages_need_nothing_from_elsewhere(site: Path) -> None:
    """A reader may be offline: pages load no script, style, font or picture from another place."""
    pages = list(site.rglob("*.html"))
    assert len(pages) > 40
    loads = re.compile(r'<(?:script|img|iframe)[^>]*src="(?:https?:)?//|<link[^>]*href="https?://')
    assert [page.name for page in pages if loads.search(page.read_text())] == []


@needs_mkdocs
@pytest.mark.parametrize("good", [True, False])
def test_what_is_broken_fails(tmp_path: Path, good: bool) -> None:
    """The settings of the site, on a good page, and on one that names three things that are not."""
    settings = (ROOT / "mkdocs.yml").read_text()
    settings = re.sub(r"(?ms)^(nav|hooks):.*?^(?=[#\n])", "", settings)
    settings = settings.replace("docs/lazy", f"{ROOT}/docs/lazy").replace("[.]", f"[{ROOT}]")
    (tmp_path / "mkdocs.yml").write_text(settings)
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "site.css").write_text("")
    sound = ["index.md", "#place", "warp_deform.errors.InputError"]
    broken = ["missing.md", "#nowhere", "warp_deform.errors.Missing"]
    page, place, name = sound if good else broken
    (tmp_path / "docs" / "index.md").write_text(
        f"# A page\n\n## Place\n\n[a]({page}) [b]({place}) [c][{name}]\n\n::: warp_deform.errors\n"
    )
    done = build(tmp_path / "mkdocs.yml", tmp_path / "site")
    assert (done.returncode == 0) == good, done.stdout + done.stderr
    assert [each for each in broken if (each in done.stdout + done.stderr) == good] == []


@needs_mkdocs
def test_links_to_files_of_the_repository() -> None:
    """Pages become pages and other files their paths; what is not there is an error."""
    from mkdocs.exceptions import PluginError

    path = ROOT / "docs" / "repository_links.py"
    spec = importlib.util.spec_from_file_location("repository_links", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def rewritten(text: str, page: str) -> str:
        file = SimpleNamespace(src_uri=page)
        changed: str = module.on_page_markdown(text, SimpleNamespace(file=file))
        return changed

    for page, text, wanted in [
        ("simulator.md", "[a](../README.md#figures)", "[a](project/readme.md#figures)"),
        (
            "project/readme.md",
            "![b](docs/images/cable-shape.png)",
            "![b](../images/cable-shape.png)",
        ),
        ("project/security.md", "[c](docs/hardware.md)", "[c](../hardware.md)"),
        ("tutorials/first-scene.md", "[d](../objects.md)", None),
        ("learning.md", "[`pyproject.toml`](../pyproject.toml)", "`pyproject.toml`"),
        ("learning.md", "[rows](../pyproject.toml)", "rows (`pyproject.toml`)"),
        ("learning.md", "`x[i](y)` [e](#f) [g](https://h)", "`x[i](y)` [e](#f) [g](https://h)"),
        ("learning.md", "[k](../benchmarks/missing.py)", None),
        ("learning.md", "[k](../../elsewhere.md)", None),
    ]:
        if wanted is None:
            with pytest.raises(PluginError, match="is no file of the repository"):
                rewritten(text, page)
        else:
            assert rewritten(text, page) == wanted
