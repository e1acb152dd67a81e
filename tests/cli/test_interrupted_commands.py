"""Ctrl-C in a command that is not a run."""

from __future__ import annotations

import json

import pytest
import typer

from rig.cli.outcome import reported


@pytest.mark.parametrize("as_json", [False, True])
def test_a_command_that_ctrl_c_stops_says_so_and_leaves_its_object(
    as_json: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(typer.Exit) as ended, reported(as_json=as_json):
        raise KeyboardInterrupt
    assert ended.value.exit_code == 130
    printed = capsys.readouterr()
    assert printed.err == "stopped by Ctrl-C; this command left nothing running\n"
    if as_json:
        answer = json.loads(printed.out)
        assert (answer["outcome"], answer["exit"]) == ("stopped", 130)
        assert answer["errors"] == ["stopped by Ctrl-C; this command left nothing running"]
    else:
        assert not printed.out
