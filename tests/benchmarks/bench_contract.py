"""Every entry of the contract in docs/safety-contract.md, 20 times: how often it held, by entry.

Run with ``pytest -m benchmark -n 0 -s tests/benchmarks/bench_contract.py``. A repetition is one
pytest over the tests of all entries; they take the combinations of stages and DAQ in turn.

    RIG_REPEATS=8           so many repetitions: once on each combination
    RIG_BENCH=az/U2542A     all on one combination
    RIG_ROWS=killed         entries with these words only (a regular expression)
    RIG_SINCE=15205df       entries that the contract of that commit does not have
    RIG_TIERS=default       without the thorough and nightly cases, which take most of the time
    RIG_SERIES_S=3600       no further repetition is begun after an hour
    RIG_REPORTS=FOLDER      run nothing; count the reports (--junitxml) of runs of the suite there
"""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

import pytest
from benches import BENCHES, CHOSEN, Bench, bench_for
from contract_page import entries_of, named_in
from measured import heading, repeats

pytestmark = [pytest.mark.benchmark, pytest.mark.timeout(28_800)]

REPOSITORY = Path(__file__).parents[2]
ROWS = os.environ.get("RIG_ROWS", "")
SINCE = os.environ.get("RIG_SINCE", "")
TIERS = os.environ.get("RIG_TIERS", "all")
SERIES_S = float(os.environ.get("RIG_SERIES_S", "inf"))
REPORTS = os.environ.get("RIG_REPORTS", "")
PAGES = ("docs/safety-contract.md", "docs/safety.md")
"""Where the contract is, and where it was in earlier commits."""


def rows_of(page: str) -> dict[str, list[str]]:
    """What happens, and the tests that show what follows."""
    return {
        what: tests
        for what, text in entries_of(page, "The contract").items()
        if (tests := [f"{path}::{name}" for path, name in named_in(text) if name])
    }


def page_at(commit: str) -> str:
    """The pages of the contract in a commit, one after the other."""
    shown = [
        subprocess.run(
            ("git", "show", f"{commit}:{page}"), cwd=REPOSITORY, capture_output=True, text=True
        )
        for page in PAGES
    ]
    assert any(one.returncode == 0 for one in shown), shown[0].stderr
    return "\n".join(one.stdout for one in shown)


def contract() -> dict[str, list[str]]:
    """The rows that were chosen."""
    rows = rows_of((REPOSITORY / PAGES[0]).read_text())
    earlier = rows_of(page_at(SINCE)) if SINCE else {}
    return {
        what: tests for what, tests in rows.items() if what not in earlier and re.search(ROWS, what)
    }


def held(tests: Sequence[str], bench: Bench, folder: Path) -> tuple[Counter[str], dict[str, str]]:
    """Run tests once on a bench: how many cases of each held, and what those said that did not."""
    report = folder / "report.xml"
    tier = [] if TIERS == "default" else ["-m", ""]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", *tier, "-p", "no:cacheprovider"]
    subprocess.run(
        [*command, f"--junitxml={report}", f"--basetemp={folder / 'cases'}", *tests],
        cwd=REPOSITORY,
        env={**os.environ, "RIG_BENCH": str(bench)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,
    )
    return held_in(report, str(bench))


def held_in(report: Path, run: str) -> tuple[Counter[str], dict[str, str]]:
    """Read a report of pytest: how many cases of each test held, and what those said that did not,
    after the name of the run."""
    good: Counter[str] = Counter()
    bad: dict[str, str] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        name = case.get("name", "")
        test = f"{case.get('classname', '').replace('.', '/')}.py::{name.partition('[')[0]}"
        wrong = [node for node in case if node.tag in ("failure", "error")]
        if wrong:
            bad[f"{test}{name.removeprefix(name.partition('[')[0])}"] = (
                f"{run}: {(wrong[0].get('message') or '')[:300]}"
            )
        elif not any(node.tag == "skipped" for node in case):
            good[test] += 1
    return good, bad


def tell(
    rows: Mapping[str, Sequence[str]], good: Mapping[str, int], bad: Sequence[tuple[str, str]]
) -> None:
    """Print how many cases of each row held, and the words of those that did not."""
    print("| row | tests | cases that held | of |")
    print("|---|---|---|---|")
    for what, tests in rows.items():
        fine = sum(good.get(test, 0) for test in tests)
        failed = sum(name.partition("[")[0] in tests for name, _ in bad)
        print(f"| {what} | {len(tests)} | {fine} | {fine + failed} |")
    for name, words in bad:
        print(f"{name}: {words}")


def test_the_rows_of_the_contract_hold_every_time(tmp_path: Path) -> None:
    rows = contract()
    tests = list(dict.fromkeys(itertools.chain.from_iterable(rows.values())))
    assert tests, "no row was chosen"
    heading(f"{len(tests)} tests of {len(rows)} rows, tiers {TIERS}")
    good: Counter[str] = Counter()
    bad: list[tuple[str, str]] = []
    for report in sorted(Path(REPORTS).glob("*.xml")) if REPORTS else ():
        passed, failed = held_in(report, report.stem)
        good += passed
        bad += [(name, words) for name, words in failed.items() if name.partition("[")[0] in tests]
    if REPORTS:
        tell(rows, good, bad)
        assert not bad
        return
    begun_s = time.monotonic()
    benches = [bench_for("")] if CHOSEN else BENCHES
    for number, bench in enumerate(itertools.islice(itertools.cycle(benches), repeats(20)), 1):
        if time.monotonic() - begun_s > SERIES_S:
            break
        passed, failed = held(tests, bench, tmp_path)
        good += passed
        bad += failed.items()
        took_s = time.monotonic() - begun_s
        print(
            f"{number}: {bench}: {passed.total()} cases held, {len(failed)} not; {took_s:.0f} s "
            "since the first",
            flush=True,
        )
        for name, words in failed.items():
            print(f"  {name}: {words}", flush=True)
    tell(rows, good, bad)
    assert good
    assert not bad
