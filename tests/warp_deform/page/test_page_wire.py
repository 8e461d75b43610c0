"""Messages both ways: what comes back is what went, and nothing else is understood."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest

from warp_deform.errors import InputError
from warp_deform.page.wire import NotUnderstoodError, pack, parse_job, unpack

VERBS = {"act": {"pick": list, "turn": float}, "reset": {"seed": int}, "undo": {}}


def test_a_message_comes_back_and_its_arrays_are_aligned():
    arrays = {
        "bytes": np.arange(5, dtype=np.uint8),
        "q": np.arange(6, dtype=np.float32).reshape(2, 3)[:, ::-1],
        "none": np.zeros((0, 3), np.uint32),
        "faces": np.array([2**32 - 1], np.uint32),
    }
    message = pack("clip", arrays, seed=3, word="é")
    assert len(message) % 4 == 0
    back = unpack(message)
    assert (back["kind"], back["seed"], back["word"]) == ("clip", 3, "é")
    for name, array in arrays.items():
        assert back[name].shape == array.shape and (back[name] == array).all()


def test_nothing_that_is_not_finite_is_sent():
    with pytest.raises(ValueError, match="q of a message"):
        pack("clip", {"q": np.array([np.nan], np.float32)})
    with pytest.raises(ValueError):
        pack("clip", score=float("nan"))
    with pytest.raises(KeyError):
        pack("clip", {"q": np.zeros(1)})  # float64 is no type of a message


def test_a_job_is_what_was_asked_for():
    job = parse_job('{"do": "act", "pick": [1, 0.5], "turn": 1, "at": 7}', VERBS)
    assert (job.do, job.at, job.numbers("pick", 2), job.number("turn")) == ("act", 7, [1, 0.5], 1)
    assert parse_job('{"do": "undo"}', VERBS).at == -1


@pytest.mark.parametrize(
    "raw",
    [
        b'{"do": "undo"}', "", "null", "[]", "1", "undo", '{"do": "undo"', '{"undo": {}}',
        '{"do": null}', '{"do": ["undo"]}', '{"do": "__class__"}', '{"do": "undo", "more": 1}',
        '{"do": "act", "pick": []}', '{"do": "act", "pick": [NaN], "turn": 0}', "[" * 3000,
        '{"do":"undo","at":' + "[" * 3000, '{"do": "undo", "at": "1"}',
        '{"do": "undo", "at": true}',
        '{"do": "act", "pick": [1, 2], "turn": Infinity}',
    ],
)  # fmt: skip
def test_what_no_page_sends_is_not_understood(raw):
    with pytest.raises(NotUnderstoodError):
        parse_job(raw, VERBS)


@pytest.mark.parametrize(
    "values",
    [
        {"do": "reset", "seed": "abc"}, {"do": "reset", "seed": 1.0}, {"do": "reset", "seed": True},
        {"do": "reset", "seed": None}, {"do": "act", "pick": "12", "turn": 0},
        {"do": "act", "pick": [], "turn": {}},
    ],
)  # fmt: skip
def test_values_of_another_type_are_told(values):
    with pytest.raises(InputError):
        parse_job(json.dumps(values), VERBS)


@pytest.mark.parametrize("pick", ["[1]", "[1,2,3]", '[1,"2"]', "[1,null]", "[1,true]", "[1,1e999]",
                                  f"[1,{10**400}]", "[[1],2]"])  # fmt: skip
def test_numbers_are_numbers_and_so_many(pick):
    job = parse_job('{"do": "act", "turn": 0, "pick": ' + pick + "}", VERBS)
    with pytest.raises(InputError):
        job.numbers("pick", 2)


def test_the_head_is_little_endian():
    message = pack("note", text="x")
    (length,) = struct.unpack("<I", message[:4])
    assert json.loads(message[4 : 4 + length])["text"] == "x"
