"""What a sweep adds up: derivatives of a loss by the state, the parameters and the paths."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from ..config import WORLD_PARAMETERS
from ..lanes.tape import Kind
from ..packing.data import SolverData
from ..packing.mirrored import Mirrored

__all__ = ["Derivatives", "spring_rows"]

_BODY = ("x", "q", "v", "omega")
_ADJOINT_OF = {"particles.x": "x", "particles.v": "v"} | {f"bodies.{n}": f"body.{n}" for n in _BODY}
_OUT = ("x", "v", *WORLD_PARAMETERS, "time", "position", "rotation", "fired",
        *(f"body.{n}" for n in _BODY), "body.w")  # fmt: skip
_OF_PARTS = ("mass", "radius", "softness", "rest")


class Derivatives:
    """The arrays of the structs `Adjoint` and `BodyAdjoint`, which are `by_state` and `by_bodies`.

    The arrays of knots are as long as the solver's when this was made.

    Args:
        knots: room for so many of them; None: as the solver has
    """

    def __init__(self, data: SolverData, *, knots: int | None = None) -> None:
        self._data, self._knots = data, data.knot_room if knots is None else knots
        self._arrays = self._new_arrays()
        self._spring_first = wp.array(_spring_places(data)[0], dtype=wp.int32, device=data.device)
        self._springs = spring_rows(data)
        self.by_state, self.by_bodies = self._structs()

    def _mirrored(self, count: int, dtype: Any, shape: tuple[int, ...]) -> Mirrored:
        return Mirrored(count, dtype, self._data.device, self._data.number, shape)

    def _new_arrays(self) -> dict[str, Mirrored]:
        data = self._data
        t, L, groups = data.types, data.lanes, data.group_count
        particles, knots = int(data.group_particle[-1]), self._knots
        arrays = {name: self._mirrored(particles, t.V3, (3, L)) for name in ("x", "v", "xp")}
        scratch = ("then_x", "then_v", "then_g", "then_h")
        arrays |= {name: self._mirrored(particles, t.V3, (3, L)) for name in scratch}
        arrays |= {name: self._mirrored(particles, t.V, (L,)) for name in ("w", "mass", "radius")}
        springs = _spring_places(data)[1]
        arrays |= {name: self._mirrored(springs, t.V, (L,)) for name in ("softness", "rest")}
        for name in WORLD_PARAMETERS:
            arrays[name] = self._mirrored(groups, t.V, (L,))
        arrays["time"] = self._mirrored(knots, t.S, ())
        arrays["position"] = self._mirrored(knots, t.R3, (3,))
        arrays["rotation"] = self._mirrored(knots, t.Q, (4,))
        arrays["shift"] = self._mirrored(groups * L, t.R3, (3,))
        arrays["pending"] = Mirrored(groups, wp.int32, data.device, np.int32, ())
        arrays["fired"] = self._mirrored(groups * len(Kind), t.V, (L,))
        bodies, contacts = int(data.group_body[-1]), len(data.arrays["contacts.mu"].view)
        for name in ("x", "v", "omega", "xp", "dx", "dr"):
            arrays[f"body.{name}"] = self._mirrored(bodies, t.R3, (3,))
        for name in ("q", "qp"):
            arrays[f"body.{name}"] = self._mirrored(bodies, t.Q, (4,))
        arrays["body.w"] = self._mirrored(bodies, t.S, ())
        arrays["body.spread"] = self._mirrored(bodies, t.M33, (3, 3))
        for name in ("ra", "rb", "normal", "across_u", "across_v", "weights", "upper", "steps",
                     "impulse"):  # fmt: skip
            arrays[f"body.{name}"] = self._mirrored(contacts, t.R3, (3,))
        arrays["body.mu"] = self._mirrored(contacts, t.S, ())
        return arrays

    def _structs(self) -> tuple[Any, Any]:
        data = self._data
        struct, of_bodies = data.types.Adjoint(), data.types.BodyAdjoint()
        for name, mirrored in self._arrays.items():
            owner, _, field = name.rpartition(".")
            setattr(of_bodies if owner else struct, field, mirrored.array)
        for name in ("x", "xp", "w", "mass", "radius"):
            array = self._arrays[name].array
            count = array.capacity // np.dtype(data.number).itemsize
            flat = wp.array(ptr=array.ptr, dtype=data.scalar, shape=(count,), device=array.device)
            setattr(struct, f"{name}_flat", flat)
        struct.spring_first = self._spring_first
        return struct, of_bodies

    def clear(self, inverse_masses: np.ndarray) -> None:
        """All derivatives are 0 before a sweep; the inverse masses are those at its end."""
        for mirrored in self._arrays.values():
            mirrored.view[...] = 0
        self._arrays["w"].view[...] = inverse_masses
        for mirrored in self._arrays.values():
            mirrored.to_device()

    def add(self, cotangent: Mapping[str, np.ndarray]) -> None:
        """Add derivatives by arrays of the state, which have their names in `SolverData`."""
        for name, values in cotangent.items():
            mirrored = self._arrays[_ADJOINT_OF[name]]
            mirrored.to_host()
            mirrored.view[...] += values
            mirrored.to_device()

    def read(
        self, inputs: Mapping[str, np.ndarray], dt: float, *, parts: bool
    ) -> dict[str, np.ndarray]:
        """Copies, see `Recorder.backward`; by parameters as users set them.

        Args:
            inputs: what the rollout was set up with, see `Checkpoints.save_inputs`
        """
        out = {}
        for name in _OUT:
            self._arrays[name].to_host()
            out[name] = self._arrays[name].view.copy()
        data = self._data
        damping, stiffness = (inputs[f"group.{n}"] for n in ("damping", "stiffness"))
        # what is pinned has no mass to derive by
        out["body.w"] *= inputs["bodies.w0"] > 0.0
        out["damping"] *= np.where(damping * dt < 1.0, -dt, 0.0)
        out["stiffness"] *= -1.0 / (stiffness * dt) ** 2
        out["fired"] = out["fired"].reshape(data.group_count, len(Kind), data.lanes)
        if not parts:
            for name in _OF_PARTS:
                out[name] = np.full_like(self._arrays[name].view, np.nan)
            out["spring_stiffness"] = out.pop("softness")
            return out
        for name in _OF_PARTS:
            self._arrays[name].to_host()
            out[name] = self._arrays[name].view.copy()
        softness = out.pop("softness")
        out["spring_stiffness"] = np.zeros_like(softness)
        for group, (rows, springs) in enumerate(self._springs):
            passes = int(data.views["topology.passes"][data.group_topology[group]])
            by_compliance = softness[rows] * (passes / (stiffness[group] * dt**2))
            squared = inputs["springs.compliance"][springs, None] ** 2
            out["spring_stiffness"][rows] = -by_compliance * squared
        return out


def spring_rows(data: SolverData) -> list[tuple[slice, slice]]:
    """Of every group: where derivatives by its springs stand, and the springs."""
    first, _ = _spring_places(data)
    start = data.views["topology.spring_start"]
    rows = []
    for group, k in enumerate(data.group_topology):
        springs = slice(int(start[k]), int(start[k + 1]))
        rows.append(
            (slice(springs.start + int(first[group]), springs.stop + int(first[group])), springs)
        )
    return rows


def _spring_places(data: SolverData) -> tuple[np.ndarray, int]:
    """`Adjoint.spring_first`, and the number of springs of all groups."""
    start = data.views["topology.spring_start"]
    counts = [int(start[k + 1] - start[k]) for k in data.group_topology]
    place = np.cumsum([0, *counts])
    first = place[:-1] - start[np.asarray(data.group_topology, int)]
    return first.astype(np.int32), int(place[-1])
