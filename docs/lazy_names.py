"""Lazy names of packages (`lazy_exports`) for the reference pages, which read and never import.

A griffe extension. A package says in `_HOME` which module defines each name; what reads the source
alone sees neither the names nor the `__all__` that is computed from them.
"""

from __future__ import annotations

import ast
from importlib.util import resolve_name
from typing import Any

from griffe import Alias, Attribute, Extension, GriffeLoader, Module

HOMES = "_HOME"


class LazyNames(Extension):
    """Gives every package its lazy names, and the `__all__` that lists them."""

    def on_package(self, *, pkg: Module, loader: GriffeLoader, **kwargs: Any) -> None:
        """Add them to the package and to all packages below it."""
        for module in [pkg, *_below(pkg)]:
            homes = _homes(module)
            if not homes:
                continue
            for name, home in homes.items():
                module.set_member(name, Alias(name, f"{resolve_name(home, module.path)}.{name}"))
            listed = ast.parse(str(module["__all__"].value), mode="eval")
            strings = [n.value for n in ast.walk(listed) if isinstance(n, ast.Constant)]
            module.exports = [*homes, *(str(name) for name in strings if name != "__version__")]


def _below(module: Module) -> list[Module]:
    inner = [each for each in module.modules.values() if not each.is_alias]
    return [*inner, *(deeper for each in inner for deeper in _below(each))]


def _homes(module: Module) -> dict[str, str]:
    attribute = module.members.get(HOMES)
    if not isinstance(attribute, Attribute):
        return {}
    homes: dict[str, str] = ast.literal_eval(str(attribute.value))
    return homes
