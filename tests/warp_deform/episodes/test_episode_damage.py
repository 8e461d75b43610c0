"""Damaged, foreign and forged episode files: one line that names the file, nothing else."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fixtures.episode_samples import (
    assert_same_record,
    make_episode,
    with_info,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from warp_deform.episodes import (
    Episode,
    EpisodeReader,
    EpisodeWriter,
    _parquet,
    _records,
    episode_name,
)
from warp_deform.errors import InputError

RANDOM = settings(derandomize=True, deadline=None, max_examples=150)


@pytest.fixture(scope="module")
def sealed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes, Episode]:
    """A folder to spoil, the bytes of a whole episode with a goal, and what is read from them."""
    folder = tmp_path_factory.mktemp("sealed")
    path = EpisodeWriter(folder).write(make_episode(goal=True))
    return folder, path.read_bytes(), EpisodeReader(folder).read(0)


def read_bytes(folder: Path, data: bytes) -> Episode:
    (folder / episode_name(0)).write_bytes(data)
    return EpisodeReader(folder).read(0)


def forge(data: bytes, change: Callable[[bytes], bytes]) -> bytes:
    """Change the footer and renew the seal, as only a program that knows the format could."""
    start = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    footer = change(data[start:])
    assert len(footer) == len(data) - start
    return data[: start - 16] + _parquet.digest(footer) + footer


def test_reading_one_row_ignores_damage_in_another(
    tmp_path: Path, sealed: tuple[Path, bytes, Episode]
) -> None:
    _, data, expected = sealed
    spoiled = bytearray(data)
    spoiled[100] ^= 1  # within the first row group
    (tmp_path / episode_name(0)).write_bytes(spoiled)
    reader = EpisodeReader(tmp_path)
    assert reader.info(0) == expected.info
    assert_same_record(reader.read_step(0, 1), expected.steps[1], tolerance=0.0)
    with pytest.raises(InputError, match="row 0 is damaged"):
        reader.read_step(0, 0)


@RANDOM
@given(data=st.data())
def test_flipped_bytes_are_noticed(
    sealed: tuple[Path, bytes, Episode], data: st.DataObject
) -> None:
    folder, whole, _ = sealed
    spoiled = bytearray(whole)
    places = st.one_of(
        st.integers(0, len(whole) - 1), st.integers(len(whole) - 200, len(whole) - 1)
    )
    for place in data.draw(st.lists(places, min_size=1, max_size=4, unique=True)):
        spoiled[place] ^= data.draw(st.integers(1, 255))
    with pytest.raises(InputError) as caught:
        read_bytes(folder, bytes(spoiled))
    assert episode_name(0) in str(caught.value) and "\n" not in str(caught.value)


@RANDOM
@given(data=st.data())
def test_truncated_and_extended_files_are_noticed(
    sealed: tuple[Path, bytes, Episode], data: st.DataObject
) -> None:
    folder, whole, _ = sealed
    part = whole[: data.draw(st.integers(0, len(whole)))]
    garbage = data.draw(st.binary(max_size=60))
    tail = data.draw(st.sampled_from([b"", whole[-8:], whole[-len(whole) // 2 :]]))
    spoiled = part + garbage + tail
    if spoiled != whole:
        with pytest.raises(InputError, match=episode_name(0)):
            read_bytes(folder, spoiled)


@RANDOM
@given(data=st.data())
def test_forged_footers_raise_nothing_else(
    sealed: tuple[Path, bytes, Episode], data: st.DataObject
) -> None:
    folder, whole, expected = sealed

    def change(footer: bytes) -> bytes:
        spoiled = bytearray(footer)
        for place in data.draw(st.lists(st.integers(0, len(footer) - 9), max_size=3)):
            spoiled[place] = data.draw(st.integers(0, 255))
        return bytes(spoiled)

    try:
        actual = read_bytes(folder, forge(whole, change))
    except InputError as error:
        assert episode_name(0) in str(error) and "\n" not in str(error)
    else:  # statistics or names that nothing reads, or a changed word of the metadata
        for a, b in zip(actual.steps, expected.steps, strict=True):
            assert_same_record(a, b, tolerance=0.0)


@pytest.mark.parametrize(
    "content",
    [b"", b"PAR1", b"\x89PNG\r\n\x1a\n" + bytes(99), b"{}" * 99, bytes(10_000), b"PAR1" * 50],
)
def test_other_kinds_of_file(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(InputError, match="cannot be read as an episode"):
        read_bytes(tmp_path, content)


def test_foreign_parquet_file(tmp_path: Path) -> None:
    pq.write_table(pa.table({"x": np.arange(1000)}), tmp_path / episode_name(0))
    with pytest.raises(InputError, match="warp-deform did not write it"):
        EpisodeReader(tmp_path).read(0)


def test_episode_that_another_program_has_rewritten(
    tmp_path: Path, sealed: tuple[Path, bytes, Episode]
) -> None:
    path = tmp_path / episode_name(0)
    path.write_bytes(sealed[1])
    pq.write_table(pq.read_table(path), path)
    with pytest.raises(InputError, match="warp-deform did not write it"):
        EpisodeReader(tmp_path).read(0)


def test_format_of_a_future_version(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(_records, "FORMAT", 3)
        EpisodeWriter(tmp_path).write(with_info(make_episode(), format=3))
    with pytest.raises(InputError, match=r"format version 3.*upgrade warp-deform"):
        EpisodeReader(tmp_path).infos()


def test_other_columns(tmp_path: Path, sealed: tuple[Path, bytes, Episode]) -> None:
    renamed = forge(sealed[1], lambda footer: footer.replace(b"sim_seconds", b"sim_minutes"))
    with pytest.raises(InputError):
        read_bytes(tmp_path, renamed)


def test_image_of_another_size_is_refused_before_it_is_decoded(
    tmp_path: Path, sealed: tuple[Path, bytes, Episode]
) -> None:
    forged = forge(sealed[1], lambda footer: footer.replace(b'"width": 12', b'"width": 99'))
    with pytest.raises(InputError, match="no PNG of 16 x 99 pixels"):
        read_bytes(tmp_path, forged)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_pipes_and_folders_do_not_block(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / episode_name(0))
    (tmp_path / episode_name(1)).mkdir()
    reader = EpisodeReader(tmp_path)
    for seed in (0, 1):
        with pytest.raises(InputError, match="no regular file"):
            reader.read(seed)
