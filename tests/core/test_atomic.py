"""Files that appear whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rig.core.atomic import replacing, write_bytes, write_text


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    target = tmp_path / "report.json"
    write_text(target, "first")
    write_text(target, "second µ", shared=True)
    assert target.read_text(encoding="utf-8") == "second µ"
    write_bytes(target, b"\x00\x01", durable=False)
    assert target.read_bytes() == b"\x00\x01"
    assert names(tmp_path) == ["report.json"]


@pytest.mark.parametrize("shared", [False, True])
def test_an_error_leaves_the_earlier_file_and_no_temporary_one(
    tmp_path: Path, shared: bool
) -> None:
    target = tmp_path / "report.json"
    write_text(target, "first")

    def interrupted() -> None:
        with replacing(target, shared=shared) as part:
            part.write_text("half of the sec")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert target.read_text() == "first"
    assert names(tmp_path) == ["report.json"]


def test_the_earlier_file_is_readable_until_the_new_one_is_whole(tmp_path: Path) -> None:
    target = tmp_path / "report.json"
    write_text(target, "first")
    with replacing(target) as part:
        part.write_text("second")
        assert target.read_text() == "first"
    assert target.read_text() == "second"


def test_what_a_killed_process_left_is_overwritten(tmp_path: Path) -> None:
    target = tmp_path / "report.json"
    with replacing(target) as part:
        name = part.name
        part.write_text("x")
    (tmp_path / name).write_text("left by a kill")
    write_text(target, "second")
    assert names(tmp_path) == ["report.json"]


def test_two_writers_of_a_shared_target_do_not_meet(tmp_path: Path) -> None:
    target = tmp_path / "result.h5"
    with replacing(target, shared=True) as one, replacing(target, shared=True) as other:
        one.write_text("one")
        other.write_text("other")
    assert target.read_text() == "one"  # its block ended last
    assert names(tmp_path) == ["result.h5"]


def test_content_is_on_the_disk_before_the_name_and_the_folder_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps: list[str] = []
    sync, rename = os.fsync, Path.replace

    def fsync(descriptor: int) -> None:
        steps.append(f"sync {Path(f'/proc/self/fd/{descriptor}').readlink().name}")
        sync(descriptor)

    def replace(part: Path, target: Path) -> Path:
        steps.append("rename")
        return rename(part, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    write_text(tmp_path / "a.txt", "content")
    assert steps == ["sync .a.txt.part", "rename", f"sync {tmp_path.name}"]


def test_a_read_only_file_can_be_published(tmp_path: Path) -> None:
    target = tmp_path / "run.h5"
    for content in (b"one", b"two"):
        with replacing(target) as part:
            part.write_bytes(content)
            part.chmod(0o444)
    assert target.read_bytes() == b"two"
    assert target.stat().st_mode & 0o777 == 0o444
