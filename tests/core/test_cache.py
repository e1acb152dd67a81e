"""The disk cache: a hit is what was stored, anything else is a miss, and losing it costs time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rig.core.cache import DiskCache, NoCache, user_cache

KEY, CONTENT = "contact of a hemisphere, mesh 3", bytes(range(256)) * 2


@pytest.fixture
def cache(tmp_path: Path) -> DiskCache:
    return DiskCache(tmp_path / "cache")


@pytest.mark.parametrize("content", [b"", b"x", CONTENT])
@pytest.mark.parametrize("key", ["", "plain", "../../etc/passwd", "a\0b", "µ" * 500])
def test_what_is_put_is_got_under_any_key(cache: DiskCache, key: str, content: bytes) -> None:
    assert cache.get(key) is None
    cache.put(key, content)
    assert cache.get(key) == content
    assert cache.get(key + "'") is None
    assert cache.path(key).parent == cache.folder


def test_the_last_put_counts(cache: DiskCache) -> None:
    cache.put(KEY, b"old")
    cache.put(KEY, b"new")
    assert cache.get(KEY) == b"new"
    assert len(list(cache.folder.iterdir())) == 1


@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_file_is_a_miss(cache: DiskCache, data: st.DataObject) -> None:
    cache.put(KEY, CONTENT)
    path = cache.path(KEY)
    raw = bytearray(path.read_bytes())
    damage = data.draw(st.sampled_from(["flip", "cut", "append", "zero"]))
    at = data.draw(st.integers(0, len(raw) - 1))
    if damage == "flip":
        raw[at] ^= data.draw(st.integers(1, 255))
    elif damage == "cut":
        del raw[at:]
    elif damage == "append":
        raw += data.draw(st.binary(min_size=1, max_size=64))
    else:
        raw[at:] = bytes(len(raw) - at)
    changed = bytes(raw) != path.read_bytes()
    path.write_bytes(raw)
    assert (cache.get(KEY) is None) == changed
    cache.put(KEY, CONTENT)
    assert cache.get(KEY) == CONTENT, "a damaged entry is replaced"


def test_anothers_entry_under_this_name_is_a_miss(cache: DiskCache) -> None:
    cache.put("other", CONTENT)
    cache.path("other").rename(cache.path(KEY))
    assert cache.get(KEY) is None


def test_a_folder_that_cannot_be_written_costs_nothing_but_the_cache(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    cache = DiskCache(tmp_path / "file")
    cache.put(KEY, CONTENT)
    assert cache.get(KEY) is None
    assert (tmp_path / "file").read_text() == "not a folder"


def test_a_folder_in_the_entrys_place_is_a_miss_and_leaves_no_litter(cache: DiskCache) -> None:
    cache.path(KEY).mkdir(parents=True)
    cache.put(KEY, CONTENT)
    assert cache.get(KEY) is None
    assert list(cache.folder.iterdir()) == [cache.path(KEY)]


def test_no_cache_keeps_nothing() -> None:
    cache = NoCache()
    cache.put(KEY, CONTENT)
    assert cache.get(KEY) is None


def test_the_users_cache_can_be_put_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RIG_CACHE", str(tmp_path))
    user_cache().put(KEY, CONTENT)
    assert len(list(tmp_path.iterdir())) == 1
    monkeypatch.delenv("RIG_CACHE")
    assert "tactile-rig" in str(user_cache().folder)


SERVICE = """
import os, sys
os.environ = {"TMPDIR": sys.argv[1], "PATH": os.environ["PATH"]}
from pathlib import Path
from rig.core import cache
Path.home = classmethod(lambda cls: (_ for _ in ()).throw(RuntimeError("no home")))
place = cache.user_cache().folder
cache.user_cache().put("key", b"content")
assert cache.user_cache().get("key") == b"content"
os.access = lambda path, mode: False
cache.place_numba_cache(Path("/usr/lib/rig"))
print(place, place.stat().st_mode & 0o777 == 0o700, os.environ["NUMBA_CACHE_DIR"], sep="\\n")
"""


def test_a_user_without_a_home_has_a_cache_of_their_own_in_the_temporary_folder(
    tmp_path: Path,
) -> None:
    shown = subprocess.run(
        [sys.executable, "-c", SERVICE, str(tmp_path)], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    assert shown[0] == str(tmp_path / f"tactile-rig-cache-{os.getuid()}")
    assert shown[1:] == ["True", shown[0] + "/numba"]


def test_a_folder_of_somebody_else_in_the_temporary_folder_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"tactile-rig-cache-{os.getuid()}").mkdir(mode=0o777)
    (tmp_path / f"tactile-rig-cache-{os.getuid()}").chmod(0o777)
    for name in ("RIG_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "file").touch()  # below which even root can make no folder
    monkeypatch.setenv("HOME", str(tmp_path / "file" / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert user_cache().folder != tmp_path / f"tactile-rig-cache-{os.getuid()}"
    assert user_cache().folder.parent == tmp_path
