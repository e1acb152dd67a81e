"""A batch whose runs are disturbed by holds: it says how often, and notifies people."""

from __future__ import annotations

import json
import stat
import sys
from typing import Any

import pytest
from nights import NIGHT, ask, folder_of, object_of

pytestmark = pytest.mark.thorough

NOTIFY = """#!{python}
import json, sys
open({path!r}, "a").write(json.dumps(json.load(sys.stdin)) + "\\n")
"""
GAPS = "".join(
    '[[fault]]\ndevice = "force_sensor.stream"\nkind = "silence"\n'
    f"after_s = {seconds}\nfor_s = 0.5\n"
    for seconds in range(17, 200, 8)
)
"""Each comes while the skin is pressed: a slip trial is there 17 s after its begin, which has a
rehearsal, and 7.2 to 10 s after a gap."""


def test_a_loose_contact_ends_its_run_only_and_people_are_notified_of_it(rig: Any) -> None:
    reported = rig.folder / "reported.jsonl"
    command = rig.folder / "notify"
    command.write_text(NOTIFY.format(python=sys.executable, path=str(reported)))
    command.chmod(command.stat().st_mode | stat.S_IXUSR)
    (rig.folder / "loose.toml").write_text(GAPS)
    (rig.folder / "night.toml").write_text(
        NIGHT
        + f"""
notify = {{ command = [{str(command)!r}], on = ["failure", "hold"] }}
[simulation]
fault = [{{ runs = [1], plan = "loose.toml", attempts = 100 }}]
[[experiment]]
procedure = "slip-trial"
repeat = 2
settings = {{ speed_mm_s = 2 }}
"""
    )
    ended = rig.run("batch", "run", "night.toml", "--json")
    assert ended.code == 5, ended.stderr
    batch = folder_of(rig.results)
    assert ask(batch, "SELECT number, state, code FROM run") == [(1, "failed", 3), (2, "done", 0)]
    assert ask(batch, "SELECT run, kind FROM attempt") == [(1, "holds"), (2, "")], "not retried"
    status = object_of(ended.stdout)
    assert status["holds"] == 6
    assert status["presses"] == 9, "6 and a rehearsal of the first run, the others of the second"
    assert "in all runs: 6 holds, " in ended.stderr
    beat = json.loads((batch / "heartbeat.json").read_text())
    assert (beat["holds"], beat["presses"]) == (6, status["presses"])
    messages = [json.loads(line) for line in reported.read_text().splitlines()]
    assert [message["occasion"] for message in messages] == ["hold", "failure"]
    assert "run 1 at " in messages[0]["text"]
    assert "the force sensor is silent" in messages[0]["text"]
    assert "6 holds at trial-001" in messages[1]["text"]
