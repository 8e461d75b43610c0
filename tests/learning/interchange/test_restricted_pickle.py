"""Pickles are read by a process that can run nothing of theirs."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fixtures.original_recordings import (
    NUMPY_1,
    NUMPY_2,
    array_opcodes,
    dtype,
    name,
    opcodes,
    pickled,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from learning.interchange import restricted_pickle
from learning.interchange.restricted_pickle import read_pickles
from warp_deform.errors import InputError

PROGRAM = Path(restricted_pickle.__file__).with_name("_pickle_process.py")
VALUES = [
    {"a": [1, -2.5, None, True, "é"], 7: ((0.1, 0.2, 0.3), (0.0, 0.0, 0.0, 1.0))},
    [np.float64(0.1), np.int64(-3), np.bool_(True), np.float32(0.5)],
    np.arange(24, dtype=np.uint8).reshape(2, 3, 4),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.zeros((0, 3), np.float32),
    np.array([1, 2], ">i4"),
]


def written(folder: Path, data: bytes) -> Path:
    path = folder / "a.pkl"
    path.write_bytes(data)
    return path


def same(actual: object, expected: object) -> bool:
    """Equal, where lists stand for tuples and Python's numbers for NumPy's."""
    if isinstance(expected, np.ndarray):
        assert isinstance(actual, np.ndarray)
        return actual.dtype == expected.dtype and np.array_equal(actual, expected)
    if isinstance(expected, dict):
        assert isinstance(actual, dict)
        return actual.keys() == expected.keys() and all(
            same(actual[k], expected[k]) for k in actual
        )
    if isinstance(expected, list | tuple):
        assert isinstance(actual, list)
        return all(same(a, b) for a, b in zip(actual, expected, strict=True))
    return bool(actual == expected)


@pytest.mark.parametrize("multiarray", [NUMPY_1, NUMPY_2])
def test_data_is_read(tmp_path: Path, multiarray: str) -> None:
    paths = [tmp_path / f"{i}.pkl" for i in range(len(VALUES))]
    for path, value in zip(paths, VALUES, strict=True):
        path.write_bytes(pickled(value, multiarray=multiarray))
    assert same(read_pickles(paths), VALUES)


def test_an_array_that_occurs_often_is_sent_once(tmp_path: Path) -> None:
    value = opcodes(np.arange(10**6)) + b"q\x00" + b"h\x00" * 999
    (items,) = read_pickles([written(tmp_path, b"\x80\x03(" + value + b"l.")])
    assert len(items) == 1000
    assert all(item is items[0] for item in items)


def call(module: str, function: str, *arguments: object) -> bytes:
    return name(module, function) + opcodes(arguments) + b"R."


LIVE = {
    "posix.system": lambda mark: call("posix", "system", f"touch {mark}"),
    "os.system": lambda mark: call("os", "system", f"touch {mark}"),
    "subprocess.Popen": lambda mark: call("subprocess", "Popen", ["touch", mark]),
    "builtins.eval": lambda mark: call("builtins", "eval", f"open({mark!r}, 'w')"),
    "builtins.exec": lambda mark: call("builtins", "exec", f"open({mark!r}, 'w')"),
    "builtins.open": lambda mark: f"(S'{mark}'\nS'w'\nibuiltins\nopen\n.".encode(),  # INST
    "numpy.save": lambda mark: call("numpy", "save", mark, 1),
}
"""Payloads that leave a mark where they run, by the name that they ask for."""
NAMED = {
    "builtins.getattr": b"\x8c\x08builtins\x8c\x07getattr\x93.",  # STACK_GLOBAL
    "numpy.load": call("numpy", "load", "a.npy"),
    "numpy.fromfile": call("numpy", "fromfile", "a.npy"),
    "numpy._core.multiarray.fromfile": name(NUMPY_2, "fromfile") + b".",
    "numpy._core.multiarray._reconstruct.__globals__": name(NUMPY_2, "_reconstruct.__globals__")
    + b".",
    "numpy._core.numeric._frombuffer": name("numpy._core.numeric", "_frombuffer") + b".",
    "_codecs.encode": name("_codecs", "encode") + b".",
    "copyreg._reconstructor": name("copyreg", "_reconstructor") + b".",
    "torch.storage._load_from_bytes": name("torch.storage", "_load_from_bytes") + b".",
    "\\u0430\\x07.system": name("\u0430\x07", "system") + b".",  # reaches no terminal as it is
}
PERMISSIVE = "import pickle, sys; pickle.load(open(sys.argv[1], 'rb'))"


def mark_of(folder: Path) -> Path:
    return folder / "MARK.npy"


@pytest.mark.parametrize("asked", LIVE)
@pytest.mark.parametrize("deep", [False, True])
def test_a_payload_is_refused_by_name_and_not_run(tmp_path: Path, asked: str, deep: bool) -> None:
    payload = LIVE[asked](str(mark_of(tmp_path)))
    if deep:  # in a list, behind a real array
        payload = b"](" + opcodes(np.zeros(3)) + payload[:-1] + b"e."
    path = written(tmp_path, b"\x80\x04" + payload)
    with pytest.raises(InputError, match=re.escape(f"{path} asks for '{asked}'")):
        read_pickles([path])
    assert not mark_of(tmp_path).exists()


@pytest.mark.parametrize("asked", ["posix.system", "builtins.eval"])
def test_the_payloads_do_run_elsewhere(tmp_path: Path, asked: str) -> None:
    path = written(tmp_path, b"\x80\x04" + LIVE[asked](str(mark_of(tmp_path))))
    subprocess.run([sys.executable, "-c", PERMISSIVE, str(path)], check=True)
    assert mark_of(tmp_path).exists()


@pytest.mark.parametrize("asked", NAMED)
def test_any_other_name_is_refused(tmp_path: Path, asked: str) -> None:
    path = written(tmp_path, b"\x80\x04" + NAMED[asked])
    with pytest.raises(InputError, match=re.escape(f"{path} asks for '{asked}'")) as refused:
        read_pickles([path])
    assert str(refused.value).isprintable()


STATE = opcodes(1) + opcodes((3,))
BOMBS = {
    "an array's room before its bytes": (
        array_opcodes(
            STATE + dtype(np.dtype("f8")) + opcodes(False) + opcodes(bytes(24)), shape=(10**12,)
        ),
        "unknown form",
    ),
    "an array without bytes": (
        array_opcodes(
            opcodes(1) + opcodes((10**15,)) + dtype(np.dtype("f8")) + opcodes(False) + opcodes(b"")
        ),
        "0 bytes for an array",
    ),
    "a negative length": (
        array_opcodes(
            opcodes(1)
            + opcodes((-1, -24))
            + dtype(np.dtype("u1"))
            + opcodes(False)
            + opcodes(bytes(24))
        ),
        "impossible shape",
    ),
    "objects": (
        array_opcodes(STATE + name("numpy", "dtype") + opcodes(("O8", False, True)) + b"R"),
        "values of type 'O8'",
    ),
    "objects behind numbers": (
        array_opcodes(STATE + dtype(np.dtype("f8")) + opcodes(False) + opcodes([None] * 3)),
        "array of objects",
    ),
    "structured values": (dtype(np.dtype("f8"), fields={"a": 1}), "structured values"),
    "a changed function": (name(NUMPY_2, "scalar") + b"}X\x01\x00\x00\x00aK\x01sb", "a function"),
    "a dtype of nothing": (name("numpy", "dtype") + b")R", "damaged"),
    "ndarray by its name": (name("numpy", "ndarray") + b"(K\x03tR", "unknown form"),
    "a persistent object": (b"Pmark\n", "outside of itself"),
    "an extension": (b"\x82\x01", "damaged"),
    "bytes that are not there": (b"\x8e" + (2**60).to_bytes(8, "little"), "more memory"),
    "room that is not there": (b"\x96" + (2**60).to_bytes(8, "little"), "more memory"),
    "a frame that is not there": (b"\x95" + (2**50).to_bytes(8, "little") + b"N", "more memory"),
    "a distant memo": (b"Nr\xff\xff\xff\xff", "more memory"),
    "a huge number": (b"\x8b" + (10**6).to_bytes(4, "little") + b"\x7f" * 10**6, "type int"),
    "doublings": (b"]" + b"".join(b"q%c](h%ch%ce" % (i, i, i) for i in range(40)), "levels"),
    "a hundred of a hundred of": (
        b"]" + b"".join(b"q%c](" % i + b"h%c" % i * 100 + b"e" for i in range(6)),
        "values",
    ),
    "depth": (b"]" * 10**5 + b"a" * (10**5 - 1), "levels"),
    "a list in itself": (b"]q\x00h\x00a", "levels"),
    "a set": (b"\x8f(K\x01\x90", "type set"),
    "bytes": (opcodes(b"abc"), "type bytes"),
    "a long text": (opcodes("a" * 10**5), "type str"),
    "keys of another kind": (b"}(N" + b"K\x01u", "keys"),
    "two values": (b"N.N", "more than one value"),
    "no end": (b"(K\x01", "damaged"),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_what_is_no_plain_data_is_refused(tmp_path: Path, kind: str) -> None:
    payload, expected = BOMBS[kind]
    path = written(tmp_path, b"\x80\x05" + payload + (b"" if kind == "no end" else b"."))
    with pytest.raises(InputError, match=expected) as refused:
        read_pickles([path])
    assert str(path) in str(refused.value)


@pytest.mark.parametrize("data", [b"", b"no pickle\n", b"\x89PNG\r\n\x1a\n", b"\x80\x09."])
def test_what_is_no_pickle_is_refused(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(InputError, match=r"damaged|outside of itself"):
        read_pickles([written(tmp_path, data)])


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_pickles([tmp_path / "none.pkl"])
    with pytest.raises(InputError, match="is no file"):
        read_pickles([tmp_path])
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is no file"):
        read_pickles([tmp_path / "pipe"])
    large = tmp_path / "large.pkl"
    with large.open("wb") as file:
        file.truncate(restricted_pickle.MOST_BYTES + 1)
    with pytest.raises(InputError, match="at most"):
        read_pickles([large])


def test_a_slow_file_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restricted_pickle, "_SECONDS_A_FILE", 0.0)
    with pytest.raises(InputError, match="too much time"):
        read_pickles([written(tmp_path, pickled(np.zeros(10**7)))])


@settings(derandomize=True, deadline=None, max_examples=30)
@given(st.data())
def test_any_damage_gives_a_value_or_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    whole = bytearray(pickled(VALUES[:4]))
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(2, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path = written(tmp_path_factory.mktemp("damage"), bytes(whole))
    try:
        read_pickles([path])
    except InputError as error:
        assert "\n" not in str(error)


LOCKED = """
import runpy, sys
found = runpy.run_path(sys.argv[1])
found["_limit"](2**20)
for attempt in (lambda: open(sys.argv[2], "wb", 0).write(b"x"), lambda: bytearray(2**31)):
    try:
        attempt()
    except (OSError, MemoryError) as error:
        print(type(error).__name__)
guard = found["_Guard"]()
import os
for attempt in (lambda: open("/etc/passwd"), lambda: os.system("true"), lambda: __import__("glob"),
                lambda: compile("1", "", "eval")):
    guard.on = True
    try:
        attempt()
    except found["Refused"] as error:
        guard.on = False
        print(error)
"""


def test_the_process_is_locked_even_where_code_would_run(tmp_path: Path) -> None:
    """The second lock: limits of the process, and its ear for files, processes and imports."""
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", LOCKED, str(PROGRAM), str(tmp_path / "file")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.splitlines()[:2] == ["OSError", "MemoryError"], done
    events = [line.split("'")[1] for line in done.stdout.splitlines()[2:]]
    assert events == ["open", "os.system", "import", "compile"]
