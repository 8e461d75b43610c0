"""Who may ask for what: one token, one host, one origin, and a fixed table of files.

Any program of this machine, and any page that its browser shows, can send requests to a port on the
loopback interface. The token, part of every path, keeps out who was not told; the Host header keeps
out names that an attacker's name server points here; the Origin header keeps out other pages.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files

__all__ = ["FILES", "HEADERS", "Access", "Answer", "StaticFile", "new_token"]

_KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css",
    "js": "text/javascript; charset=utf-8",
}


@dataclass(frozen=True)
class StaticFile:
    """A file that is served, of the folder `static` of a package."""

    name: str
    package: str = __package__

    @property
    def kind(self) -> str:
        """What a browser is told that it is."""
        return _KINDS[self.name.rpartition(".")[2]]

    def read(self) -> bytes:
        """Its bytes."""
        return files(self.package).joinpath("static", self.name).read_bytes()


_MODULES = ("three", "page", "connection", "scene", "shadows", "topdown", "playback", "pointer",
            "panel", "heat", "view")  # fmt: skip
FILES: Mapping[str, StaticFile] = {
    name: StaticFile(name)
    for name in ("page.css", "view.css", *(f"{module}.js" for module in _MODULES))
}
"""What is served to every session's page, by the rest of the path behind the token."""

_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
)
HEADERS = {
    "Content-Security-Policy": _POLICY,
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "Connection": "close",
}
"""What every answer says."""
SOCKET = "ws"
"""The rest of the path of the WebSocket."""


@dataclass(frozen=True)
class Answer:
    """What a request gets: a status, and with 200 a file; 101 lets it become a WebSocket."""

    status: int
    file: StaticFile | None = None


def new_token() -> str:
    """A secret for one run of the server."""
    return secrets.token_urlsafe(16)


@dataclass(frozen=True)
class Access:
    """The rules of one server.

    Attributes:
        port: that it listens on
        files: all that is served
    """

    port: int
    token: str = field(default_factory=new_token, repr=False)
    files: Mapping[str, StaticFile] = field(default_factory=lambda: FILES, repr=False)

    @property
    def hosts(self) -> tuple[str, ...]:
        """What the Host header may say."""
        return f"127.0.0.1:{self.port}", f"localhost:{self.port}"

    @property
    def origins(self) -> tuple[str, ...]:
        """What the Origin header may say."""
        return tuple(f"http://{host}" for host in self.hosts)

    @property
    def address(self) -> str:
        """The page's address."""
        return f"http://{self.hosts[0]}/{self.token}/"

    def decide(
        self, path: str, *, hosts: Sequence[str], origins: Sequence[str], upgrade: bool
    ) -> Answer:
        """What a request gets.

        Args:
            path: as it was asked for; nothing in it is decoded or joined to a folder
            hosts: every Host header of the request
            origins: every Origin header
            upgrade: whether it asks for a WebSocket, which has to name our origin
        """
        given, slash, rest = path.partition("?")[0].removeprefix("/").partition("/")
        known = hmac.compare_digest(given.encode(errors="replace"), self.token.encode())
        ours = len(hosts) == 1 and hosts[0] in self.hosts
        same = len(origins) == 1 and origins[0] in self.origins
        if not (known and ours and (same or (not origins and not upgrade))):
            return Answer(403)
        if not slash:  # files name each other by their place behind it
            return Answer(404)
        if upgrade:
            return Answer(101 if rest == SOCKET else 404)
        return Answer(200, self.files[rest]) if rest in self.files else Answer(404)
