"""What is said of settings files that cannot be read."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import Field, ValidationError

from rig.core.errors import ConfigurationError
from rig.core.settings import Settings
from rig.core.toml_files import parse_toml, read_toml


class Link(Settings):
    """Settings of a made-up instrument."""

    host: str = Field(min_length=1)


def test_a_key_that_is_given_twice_is_named_with_its_line() -> None:
    with pytest.raises(ConfigurationError) as caught:
        parse_toml('[daq]\nhost = "a"\nport = 1\nhost = "b"\n', "bench.toml")
    assert caught.value.one_line() == (
        "bench.toml: line 4: host is given twice; remove one of the two"
    )


def test_a_file_from_an_editor_that_writes_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "night.toml"
    path.write_bytes(b'\xef\xbb\xbf[batch]\r\nname = "b"\r\n')
    assert read_toml(path, "batch file") == {"batch": {"name": "b"}}


def test_any_other_fault_keeps_its_line_and_column() -> None:
    with pytest.raises(ConfigurationError, match=r"line 2, column \d+\)$") as caught:
        parse_toml("a = 1\nb\n", "bench.toml")
    assert caught.value.hint == "correct the TOML syntax"


def test_a_binary_file_is_said_to_be_no_text_without_the_words_of_a_library(
    tmp_path: Path,
) -> None:
    path = tmp_path / "bench.toml"
    path.write_bytes(b"name\xff")
    with pytest.raises(ConfigurationError) as caught:
        read_toml(path, "bench file")
    assert caught.value.message == (
        f"{path} is not a bench file: not UTF-8 text: byte 4 is not part of one"
    )


def test_an_empty_text_is_refused_in_plain_words() -> None:
    with pytest.raises(ValidationError) as caught:
        Link(host="")
    error = ConfigurationError.from_validation(caught.value, "bench.toml")
    assert error.message == "bench.toml: host = '': must have 1 or more characters"
