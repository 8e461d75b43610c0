"""Who gets what: token, Host, Origin, and the table of files."""

from __future__ import annotations

import re

import pytest

from warp_deform.page.access import FILES, HEADERS, Access, StaticFile

PAGES = {"": StaticFile("index.html")}
ACCESS = Access(4321, "secret-token", {**FILES, **PAGES})
HOST, ORIGIN = ("127.0.0.1:4321",), ("http://127.0.0.1:4321",)


def decide(path="/secret-token/", hosts=HOST, origins=(), upgrade=False):
    return ACCESS.decide(path, hosts=hosts, origins=origins, upgrade=upgrade).status


def test_what_a_browser_asks_for_is_served():
    assert decide() == decide("/secret-token/?fine") == 200
    assert decide(hosts=("localhost:4321",), origins=("http://localhost:4321",)) == 200
    assert all(decide(f"/secret-token/{name}") == 200 for name in FILES)
    assert decide("/secret-token/ws", origins=ORIGIN, upgrade=True) == 101


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ({"path": "/"}, 403),
        ({"path": "/secret-toke"}, 403),
        ({"path": "/secret-token1/"}, 403),
        ({"path": "/sécret-token/"}, 403),
        ({"path": "/\udcff/"}, 403),
        ({"path": "//secret-token/"}, 403),
        ({"path": "http://127.0.0.1:4321/secret-token/"}, 403),
        ({"path": "/?/secret-token/"}, 403),
        ({"hosts": ()}, 403),
        ({"hosts": HOST * 2}, 403),
        ({"hosts": ("evil.example:4321",)}, 403),
        ({"hosts": ("127.0.0.1",)}, 403),
        ({"hosts": ("127.0.0.1:4321.evil.example",)}, 403),
        ({"origins": ("http://evil.example",)}, 403),
        ({"origins": ("null",)}, 403),
        ({"origins": ORIGIN * 2}, 403),
        ({"upgrade": True, "path": "/secret-token/ws"}, 403),
        ({"upgrade": True, "path": "/secret-token/ws", "origins": ("null",)}, 403),
        (
            {"upgrade": True, "path": "/secret-token/ws", "origins": ("https://127.0.0.1:4321",)},
            403,
        ),
        ({"upgrade": True, "path": "/secret-token/", "origins": ORIGIN}, 404),
        ({"path": "/secret-token/ws"}, 404),
        ({"path": "/secret-token/../page.js"}, 404),
        ({"path": "/secret-token/%2e%2e/access.py"}, 404),
        ({"path": "/secret-token/index.html"}, 404),
        ({"path": "/secret-token"}, 404),
    ],
)
def test_anything_else_is_refused(asked, status):
    assert decide(**asked) == status


def test_tokens_are_long_and_never_the_same():
    tokens = {Access(1).token for _ in range(50)}
    assert len(tokens) == 50 and all(re.fullmatch(r"[\w-]{22}", token) for token in tokens)
    assert all(token not in repr(Access(1, token)) for token in tokens)


def test_every_file_is_there_and_names_no_other_host():
    """Scripts and styles are ours alone: the policy allows nothing inline and nobody else."""
    for file in (*FILES.values(), StaticFile("index.html"), StaticFile("view.html")):
        text = file.read().decode()
        if file.name != "three.js":
            assert not re.search(
                r"https?://|\bstyle=|\bon\w+=\"|\beval\(|new Function|innerHTML", text
            )
    for page in ("index.html", "view.html"):
        named = re.findall(r'(?:src|href)="([^"]+)"', StaticFile(page).read().decode())
        assert named and set(named) <= {*FILES, "data:,"}
    modules = {m for file in FILES.values() for m in re.findall(rb'from "\./([^"]+)"', file.read())}
    assert {module.decode() for module in modules} | {"page.js", "view.js"} == {
        n for n in FILES if n.endswith(".js")
    }
    assert "unsafe" not in HEADERS["Content-Security-Policy"]
    assert StaticFile("three.LICENSE").read().startswith(b"The MIT License")
