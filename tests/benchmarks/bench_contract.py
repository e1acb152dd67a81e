"""Every row of the contract in docs/safety-contract.md, 20 times: how often it held.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_contract.py``. The repetitions take
the combinations of stages and DAQ in turn: `RIG_REPEATS=8` is once on each, `RIG_BENCH=az/U2542A`
stays on one, ``-k killed`` looks at one row.
"""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path
from xml.etree import ElementTree

import pytest
from benches import BENCHES, CHOSEN, Bench, bench_for
from measured import heading

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(14_400)]

REPOSITORY = Path(__file__).parents[2]
REPEATS = int(os.environ.get("RIG_REPEATS", "20"))
TESTS = re.compile(r"`(tests/[\w/]+\.py::\w+)`")


def contract() -> dict[str, list[str]]:
    """What happens, and the tests that show what follows."""
    text = (REPOSITORY / "docs" / "safety-contract.md").read_text()
    table = text.split("## The contract")[1].split("\n## ")[0]
    rows = [line.split("|") for line in table.splitlines() if line.startswith("| ")]
    return {row[1].strip(): TESTS.findall(row[3]) for row in rows if TESTS.search(row[3])}


def held(tests: list[str], bench: Bench, folder: Path) -> tuple[int, list[str]]:
    """Run them once on a bench: how many cases held, and what those said that did not."""
    report = folder / "report.xml"
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-m", "", "-p", "no:cacheprovider"]
    subprocess.run(
        [*command, f"--junitxml={report}", *tests],
        cwd=REPOSITORY,
        env={**os.environ, "RIG_BENCH": str(bench)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    good, bad = 0, []
    for case in ElementTree.parse(report).iter("testcase"):
        wrong = [node for node in case if node.tag in ("failure", "error")]
        skipped = any(node.tag == "skipped" for node in case)
        good += not wrong and not skipped
        bad += [
            f"{bench}: {case.get('name')}: {(node.get('message') or '')[:300]}" for node in wrong
        ]
    return good, bad


@pytest.mark.parametrize("what", contract())
def test_a_row_of_the_contract_holds_every_time(what: str, tmp_path: Path) -> None:
    tests = contract()[what]
    heading(f"{len(tests)} tests of a row, {REPEATS} times: {what}")
    good, bad = 0, Counter[str]()
    benches = [bench_for("")] if CHOSEN else BENCHES
    for bench in itertools.islice(itertools.cycle(benches), REPEATS):
        passed, failed = held(tests, bench, tmp_path)
        good += passed
        bad.update(failed)
    print(f"{good} of {good + bad.total()} cases held")
    for words, count in bad.most_common():
        print(f"{count} times: {words}")
    assert good
    assert not bad
