"""Lists in CSV as editors and spreadsheets write them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rig.core.csv_lists import read_list
from rig.core.errors import ConfigurationError

ROW = {"file": "a b.h5", "label": "slip", "motion_s": "1.9"}


@pytest.mark.parametrize(
    "written",
    [
        b"file,label,motion_s\na b.h5,slip,1.9\n",
        b"\xef\xbb\xbffile,label,motion_s\r\na b.h5,slip,1.9\r\n",
        b"\xef\xbb\xbffile;label;motion_s\r\na b.h5;slip;1,9\r\n",
        b"file\tlabel\tmotion_s\na b.h5\tslip\t1,9",
        b'"file","label","motion_s"\n\n"a b.h5"," slip ","1.9"\n,,\n',
        b"file,label,motion_s,,\na b.h5,slip,1.9,,\n",
        b"file,label,,,motion_s\na b.h5,slip,,,1.9\n",
        b"\nfile;label;motion_s\na b.h5;slip;1,9\n",
        b";;\nfile;label;motion_s\na b.h5;slip;1,9\n",
        b"sep=;\r\nfile;label;motion_s\r\na b.h5;slip;1,9\r\n",
        b"\xef\xbb\xbfsep=,\nfile,label,motion_s\na b.h5,slip,1.9\n",
        b"file;label;motion_s\ra b.h5;slip;1,9\r",
    ],
    ids=[
        *("plain", "byte order mark", "semicolons", "tabs", "quoted", "empty columns"),
        *("columns without a name", "empty first line", "empty first row", "separator stated"),
        *("comma stated", "ends of lines of an old Mac"),
    ],
)
def test_a_list_from_a_spreadsheet_is_read_whatever_its_country(
    tmp_path: Path, written: bytes
) -> None:
    path = tmp_path / "list.csv"
    path.write_bytes(written)
    names, rows = read_list(path, "list", 1000, ("file", "label"))
    assert names == list(ROW)
    assert [row.cells for row in rows] == [ROW]


def test_a_decimal_comma_is_left_alone_where_commas_separate_cells(tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    path.write_text('file,notes\na.h5,"1,9"\n')
    assert read_list(path, "list", 1000, ("file", "label"))[1][0].cells["notes"] == "1,9"


def test_a_decimal_comma_is_replaced_in_numbers_and_in_no_name(tmp_path: Path) -> None:
    path = tmp_path / "list.csv"
    path.write_text('"file";"speed, mm/s"\n2,5;2,5\n')
    (row,) = read_list(path, "list", 1000, ("file", "label"))[1]
    assert row.cells == {"file": "2,5", "speed, mm/s": "2.5"}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("file,label\n\na.h5\n", "line 3: the number of cells differs from the header"),
        ("file,label\na.h5,slip,2\n", "line 2: the number of cells differs from the header"),
        ("file,,label\na.h5,what,slip\n", "line 2: 'what' is in a column without a name"),
        ("sep=;\nfile;label\n\na.h5\n", "line 4: the number of cells differs"),
        ("file,file\na.h5,b.h5\n", "the column 'file' appears twice"),
    ],
)
def test_a_list_with_a_fault_is_refused_with_its_line(
    tmp_path: Path, text: str, words: str
) -> None:
    path = tmp_path / "list.csv"
    path.write_text(text)
    with pytest.raises(ConfigurationError, match=words):
        read_list(path, "list", 1000, ("file", "label"))
