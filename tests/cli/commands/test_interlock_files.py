"""`rig interlocks` needs a bench file, and says so where what it is given cannot be one."""

from __future__ import annotations

from typing import Any


def test_a_folder_in_place_of_the_bench_file_is_refused_with_a_remedy_of_interlocks(
    rig: Any,
) -> None:
    """To leave the file out, as other commands advise, would give no interlock at all."""
    refused = rig.run("interlocks", "--bench", ".")
    assert refused.code == 2
    assert refused.errors[0].endswith(
        "not a regular file; interlocks belong to a bench with a bench file: name it with --bench"
    )
