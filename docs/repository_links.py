"""What the site takes from outside of docs: pages of the repository, and links to its files.

A hook of mkdocs. The pages in `PAGES` stand at the root of the repository and become pages of the
site. A link from a page to any other file of the repository becomes the file's path: the site does
not hold it, the reader's clone does. A link to what does not exist stops the build.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent.parent
PAGES = {
    "README.md": "project/readme.md",
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "SECURITY.md": "project/security.md",
}
"""By its path in the repository, where each stands in the site."""
# Code stands before links: what looks like a link inside of it is none.
_LINK = re.compile(
    r"^```.*?^```|(?P<image>!?)\[(?P<text>[^\]]*)\]\((?P<target>[^)#\s]+)(?P<anchor>#[^)]*)?\)"
    r"|`[^`\n]+`",
    re.MULTILINE | re.DOTALL,
)


def on_files(files: Files, config: Any) -> Files:
    """Add the pages of the repository's root."""
    for source, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text()))
    return files


def on_page_markdown(markdown: str, page: Any, **kwargs: Any) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    uri = page.file.src_uri
    at_root = {place: source for source, place in PAGES.items()}
    folder = posixpath.dirname(at_root.get(uri, f"docs/{uri}"))

    def rewritten(match: re.Match[str]) -> str:
        target = match["target"]
        if target is None or "://" in target or target.startswith("mailto:"):
            return match[0]
        path = posixpath.normpath(posixpath.join(folder, target))
        if path.startswith("..") or not (ROOT / path).exists():
            raise PluginError(f"{uri}: {target} is no file of the repository")
        place = PAGES.get(path, path.removeprefix("docs/"))
        if path in PAGES or path.startswith("docs/"):
            link = posixpath.relpath(place, posixpath.dirname(uri) or ".")
            return f"{match['image']}[{match['text']}]({link}{match['anchor'] or ''})"
        plain = match["text"].replace("`", "")
        return f"`{path}`" if plain in path else f"{match['text']} (`{path}`)"

    return _LINK.sub(rewritten, markdown)
