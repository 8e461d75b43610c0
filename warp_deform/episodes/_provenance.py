"""Where an episode comes from: hashes of states, the processor, the versions of the software."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import platform
import re
import struct
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..errors import InputError
from ..support.version import __version__

HASH_BYTES = 16
_PACKAGES = ("warp-lang", "newton", "numpy", "torch")
# Instruction sets that could change floating-point results or the code that Warp generates.
_FLAG = re.compile(r"sse|ssse|avx|fma|f16c|bmi|amx|asimd|fphp|sve|neon|bf16|fp16")


def digest(*parts: bytes | bytearray | memoryview) -> bytes:
    """Return the BLAKE2b-128 digest of the concatenated parts, 16 bytes."""
    hasher = hashlib.blake2b(digest_size=HASH_BYTES)
    for part in parts:
        hasher.update(part)
    return hasher.digest()


def state_hash(*arrays: ArrayLike) -> str:
    """Return the BLAKE2b-128 hash of numeric arrays as 32 hexadecimal digits.

    Each array of any shape enters as float32, little-endian, C order, preceded by its shape, so
    that (6,) and (2, 3) differ. -0.0 counts as 0.0: the two compare equal in every computation
    that the simulator makes, but their bytes differ.

    Raises:
        InputError: an array is not boolean, integer or real.
    """
    hasher = hashlib.blake2b(digest_size=HASH_BYTES)
    for position, array in enumerate(arrays):
        values = np.asarray(array)
        if values.dtype.kind not in "buif":
            raise InputError(
                f"state_hash: array {position} has dtype {values.dtype}; pass real numbers"
            )
        canonical = np.ascontiguousarray(values, dtype="<f4") + np.float32(0.0)
        hasher.update(struct.pack(f"<{values.ndim + 1}q", values.ndim, *values.shape))
        hasher.update(canonical.astype("<f4", copy=False).tobytes())
    return hasher.hexdigest()


def combine_hashes(hashes: Iterable[str]) -> str:
    """Return the hash of a sequence of hexadecimal hashes; their order matters.

    A run's hash combines its episodes' hashes in seed order, an episode's its steps' in time order.

    Raises:
        InputError: an entry is not a string of hexadecimal digits.
    """
    hasher = hashlib.blake2b(digest_size=HASH_BYTES)
    for entry in hashes:
        if not isinstance(entry, str) or not re.fullmatch(r"[0-9a-f]*", entry):
            raise InputError(f"combine_hashes: {entry!r} is not lower-case hexadecimal")
        hasher.update(struct.pack("<q", len(entry)) + entry.encode("ascii"))
    return hasher.hexdigest()


@functools.cache
def cpu_fingerprint() -> str:
    """Return the processor's model and a digest of its instruction sets, on one line.

    Two machines with one fingerprint run the same machine code; two with different ones should
    still give the same bits, and the fingerprint tells where to look when they do not.
    """
    model, flags = "", set[str]()
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
    except OSError:  # not Linux, or /proc is not mounted
        text = ""
    for line in text.splitlines():
        key, _, value = line.partition(":")
        if key.strip() in ("model name", "Model", "CPU part") and not model:
            model = value.strip()
        elif key.strip() in ("flags", "Features") and not flags:
            flags = {flag for flag in value.split() if _FLAG.match(flag)}
    model = " ".join((model or platform.processor() or "unknown processor").split())
    sets = digest(" ".join(sorted(flags)).encode()).hex()[:8] if flags else "unknown"
    return f"{platform.machine()}; {model}; instruction sets {sets}"


@functools.cache
def _versions() -> tuple[tuple[str, str], ...]:
    # The code that runs says its own version: it may be a checkout that was never installed.
    versions = [("python", platform.python_version()), ("warp-deform", __version__)]
    for package in _PACKAGES:
        try:
            versions.append((package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            versions.append((package, "not installed"))
    return tuple(versions)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that decide results; imports none."""
    return dict(_versions())
