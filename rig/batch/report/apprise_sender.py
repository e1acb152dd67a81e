"""One notification to addresses that apprise serves (see `rig.batch.report.notify`).

``python -m rig.batch.report.apprise_sender`` reads it as JSON from its standard input. Exit 1 where
an address did not take it; standard error then says which and why, without the address, which may
hold a password.
"""

from __future__ import annotations

import json
import logging
import sys
from typing import Any

KINDS = {"start": "info", "failure": "failure", "hold": "warning", "end": "info"}
"""apprise's, by occasion."""


def main() -> None:
    """Serve one notification."""
    told = json.load(sys.stdin)
    failures = [
        f"address {number}: {why}"
        for number, url in enumerate(told["urls"], 1)
        if (why := _failure_of(url, told))
    ]
    if failures:
        sys.exit("; ".join(failures))


def _failure_of(url: str, told: dict[str, Any]) -> str:
    import apprise

    sender = apprise.Apprise()
    with apprise.LogCapture(level=logging.WARNING, fmt="%(message)s") as said:
        sent = sender.add(url) and sender.notify(
            body=told["text"], title=told["title"], notify_type=KINDS[told["occasion"]]
        )
        reasons = said.getvalue().split("\n")
    return "" if sent else next((line for line in reasons if line), "not taken")


main()
