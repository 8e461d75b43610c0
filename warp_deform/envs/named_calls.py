"""`call`, `get_attr` and `set_attr`: how others ask the environments of a vector by name.

Gymnasium's vectors of processes have them, its interface `VectorEnv` has not. Here one object
stands for all environments, so what is asked for is its own, once an environment.
"""

from __future__ import annotations

from typing import Any

from ..errors import InputError

__all__ = ["NamedCalls"]


class NamedCalls:
    """Mixed into a vector environment."""

    num_envs: int

    def call(self, name: str, *args: Any, **kwargs: Any) -> tuple[Any, ...]:
        """What the environments say to `name`, one entry each: an attribute, or a method's result.

        A result that has an entry an environment, as that of `render`, is given out one each.

        Raises:
            AttributeError: there is nothing of this name.
        """
        value = getattr(self, name)
        if not callable(value):
            return (value,) * self.num_envs
        result = value(*args, **kwargs)
        if isinstance(result, list | tuple) and len(result) == self.num_envs:
            return tuple(result)
        return (result,) * self.num_envs

    def get_attr(self, name: str) -> tuple[Any, ...]:
        """An attribute of every environment.

        Raises:
            AttributeError: there is none of this name.
        """
        return self.call(name)

    def set_attr(self, name: str, values: Any) -> None:
        """Set an attribute, which all environments share, to one value, or to a list of equal ones.

        Raises:
            InputError: the values differ, or there is no such attribute.
        """
        given = list(values) if isinstance(values, list | tuple) else [values] * self.num_envs
        if len(given) != self.num_envs or any(value != given[0] for value in given[1:]):
            raise InputError(f"the environments share {name}: give one value, or equal ones")
        if not hasattr(self, name):
            raise InputError(f"the environments have no attribute {name!r}")
        setattr(self, name, given[0])
