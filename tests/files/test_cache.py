"""The cache is bounded: the least recently used entries are removed first, also with concurrent users."""

import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from cache_entries import VALUES, key, value_of

from tgdsl.errors import TgdslError
from tgdsl.files import cache

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("TGDSL_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TGDSL_CACHE_BYTES", raising=False)
    return tmp_path / "cache"


def limit_cache(monkeypatch, count: int) -> int:
    """Limit the cache to `count` entries; return the size of one."""
    value_of(-1)
    (entry,) = cache.entries()
    cache.evict(-1)
    monkeypatch.setenv("TGDSL_CACHE_BYTES", str(count * entry.size))
    return entry.size


def set_last_use(i: int, age: float) -> None:
    """Set how long ago entry i was last used [s]."""
    os.utime(cache.folder() / f"{key(i)}.npz", (1.7e9 - age, 1.7e9 - age))


def entries_present() -> set[int]:
    return {i for i in range(40) if (cache.folder() / f"{key(i)}.npz").exists()}


def test_the_least_recently_used_entry_is_removed_first(monkeypatch):
    size = limit_cache(monkeypatch, 4)
    for i in range(4):
        value_of(i)
    for i in range(4):
        set_last_use(i, 100.0 - i)
    computed: list[int] = []
    np.testing.assert_array_equal(value_of(0, computed), np.zeros(VALUES))  # used again: 1 and 2 are now the oldest
    assert not computed
    value_of(4)
    assert entries_present() == {0, 2, 3, 4}
    value_of(5)
    assert entries_present() == {0, 3, 4, 5}
    np.testing.assert_array_equal(value_of(1, computed), np.ones(VALUES))
    assert computed == [1], "what went is made again"
    assert sum(entry.size for entry in cache.entries()) <= 4 * size


def test_foreign_files_are_kept_and_abandoned_ones_removed(place, monkeypatch):
    limit_cache(monkeypatch, 1)
    (place / "mine.npz").write_bytes(bytes(10**6))
    (place / ".notes.npz").write_bytes(bytes(10**6))
    old, new = place / ".0123456789abcdef.npz", place / ".fedcba9876543210.npz"
    old.write_bytes(bytes(10**6))
    new.write_bytes(bytes(10**6))
    os.utime(old, (1.7e9, 1.7e9))
    value_of(0)
    assert entries_present() == {0}
    assert {path.name for path in place.iterdir()} == {"mine.npz", ".notes.npz", new.name, f"{key(0)}.npz"}


def test_an_entry_larger_than_the_bound_is_not_kept(monkeypatch):
    monkeypatch.setenv("TGDSL_CACHE_BYTES", "100")
    np.testing.assert_array_equal(value_of(3), np.full(VALUES, 3.0))
    assert cache.entries() == []


def test_an_entry_has_the_permissions_of_a_new_file(place):
    """Several users may share a cache folder; no temporary file is left."""
    value_of(0)
    (entry,) = place.iterdir()
    (place / "plain").touch()
    assert entry.stat().st_mode == (place / "plain").stat().st_mode


def test_an_entry_that_cannot_be_written_is_still_returned(place, monkeypatch):
    """A half-written entry on a full disk leaves no file."""

    def full(file, *_, **__):
        file.write(b"half")
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez", full)
    np.testing.assert_array_equal(value_of(3), np.full(VALUES, 3.0))
    assert list(place.iterdir()) == []


@pytest.mark.parametrize("text", ["2 GB", "-1", "1e9", "x"])
def test_an_invalid_bound_is_refused(monkeypatch, text):
    monkeypatch.setenv("TGDSL_CACHE_BYTES", text)
    with pytest.raises(TgdslError) as caught:
        value_of(0)
    assert str(caught.value) == f'TGDSL_CACHE_BYTES is "{text}", expected a number of bytes such as 2147483648'
    monkeypatch.setenv("TGDSL_CACHE_BYTES", "")
    assert cache.max_bytes() == 2**31


def test_concurrent_evictions_remove_no_more_than_needed(monkeypatch):
    """Two processes that evict at once choose the same files."""
    size = limit_cache(monkeypatch, 40)
    for i in range(10):
        value_of(i)
        set_last_use(i, 100.0 - i)
    list_entries: Callable[[], list[cache.Entry]] = cache.entries

    def list_before_another_evicts() -> list[cache.Entry]:
        listed = list_entries()
        monkeypatch.setattr(cache, "entries", list_entries)
        assert len(cache.evict(6 * size)) == 4
        return listed

    monkeypatch.setattr(cache, "entries", list_before_another_evicts)
    assert cache.evict(6 * size) == []
    assert entries_present() == {4, 5, 6, 7, 8, 9}


PROGRAM = """
import sys
import time
sys.path[:0] = sys.argv[1:3]
from cache_entries import VALUES, value_of
import numpy as np
for turn in range(6):
    for i in range(12):
        np.testing.assert_array_equal(value_of(i), np.full(VALUES, float(i)))
"""


def test_several_processes_share_the_cache(monkeypatch):
    """Each reads entries that the others write and remove; the rest is intact and within the bound."""
    size = limit_cache(monkeypatch, 5)
    paths = [str(REPOSITORY / "tests" / "helpers"), str(REPOSITORY)]
    running = [subprocess.Popen([sys.executable, "-c", PROGRAM, *paths], stderr=subprocess.PIPE) for _ in range(3)]
    for process in running:
        _, errors = process.communicate()
        assert process.returncode == 0, errors.decode()
    cache.evict(cache.max_bytes())
    assert sum(entry.size for entry in cache.entries()) <= 5 * size
    for i in entries_present():
        computed: list[int] = []
        np.testing.assert_array_equal(value_of(i, computed), np.full(VALUES, float(i)))
        assert not computed


def test_the_command_shows_and_clears(tmp_path, place, here, monkeypatch):
    assert here(tmp_path, "cache") == (0, f"{place}: 0 entries, 0 bytes, of at most 2147483648 bytes\n", "")
    size = limit_cache(monkeypatch, 4)
    for i in range(3):
        value_of(i)
    (place / "mine.txt").write_text("x")
    assert here(tmp_path, "cache") == (0, f"{place}: 3 entries, {3 * size} bytes, of at most {4 * size} bytes\n", "")
    assert here(tmp_path, "cache", "--clear") == (0, f"{place}: removed 3 entries, {3 * size} bytes\n", "")
    assert here(tmp_path, "cache", "--clear") == (0, f"{place}: removed 0 entries, 0 bytes\n", "")
    assert [path.name for path in place.iterdir()] == ["mine.txt"]


class Marker:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


def test_an_entry_cannot_run_code(place, tmp_path):
    """Several users may share a cache folder: an entry with a pickled object counts as damaged."""
    place.mkdir()
    np.savez(place / f"{key(0)}.npz", value=np.array([Marker(tmp_path / "ran")], dtype=object))
    np.testing.assert_array_equal(value_of(0), np.zeros(VALUES))
    assert not (tmp_path / "ran").exists()
    with pytest.raises(ValueError, match="allow_pickle=False"):
        cache.cached(key(1), lambda: Marker(tmp_path / "ran"), lambda made: {"value": np.array([made])}, dict)
    assert entries_present() == {0}


def test_a_file_unfinished_for_an_hour_is_abandoned(place):
    place.mkdir()
    now = time.time()
    for name, hours in ((".0123456789abcdef.npz", 1.1), (".fedcba9876543210.npz", 0.9)):
        (place / name).write_bytes(bytes(10))
        os.utime(place / name, (now - 3600 * hours,) * 2)
    assert [entry.file.name for entry in cache.entries()] == [".0123456789abcdef.npz"]


@dataclass
class Record:
    """What `cached_record` keeps."""

    values: np.ndarray


def test_a_record_with_a_number_that_is_not_finite_is_computed_again(place):
    place.mkdir()
    np.savez(place / f"{key(0)}.npz", values=np.array([1.0, np.nan]))
    for _ in range(2):
        record = cache.cached_record(key(0), lambda: Record(np.array([1.0, 2.0])), Record)
        np.testing.assert_array_equal(record.values, [1.0, 2.0])
    with np.load(place / f"{key(0)}.npz") as archive:
        np.testing.assert_array_equal(archive["values"], [1.0, 2.0])
