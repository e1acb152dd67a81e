"""What a run says of its grip at the end: squeezes, what became of weights, latency."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from rig.core.units import counted
from rig.run.points import Reading

OUTCOMES = ("held", "averted", "lost")


def grip_summary(readings: Sequence[Reading]) -> dict[str, Any]:
    """Return the sentences on re-gripping, as a list under ``grip``; nothing where no trial had
    alarms to answer or a weight to hold."""
    sentences = []
    squeezed = [r for r in readings if r.get("squeezes")]
    if squeezed:
        times = int(sum(float(r["squeezes"] or 0) for r in squeezed))
        sentences.append(
            f"Grip: {counted(times, 'squeeze')} in {len(squeezed)} of "
            f"{counted(len(readings), 'trial')}."
        )
    latencies_ms = [
        1e3 * float(s)
        for r in squeezed
        if not r.get("invalid") and (s := r.get("squeeze_risen_s")) is not None
    ]
    if latencies_ms:
        sentences.append(
            "From the alarm's sample to F_n + 10 % of the step: "
            f"{statistics.median(latencies_ms):.1f} ms (median of {len(latencies_ms)}), "
            f"at most {max(latencies_ms):.1f} ms."
        )
    hung = [r for r in readings if r.get("outcome")]
    outcomes = Counter(str(r["outcome"]) for r in hung if not r.get("invalid"))
    if hung:
        counts = ", ".join(f"{name} {outcomes[name]}" for name in OUTCOMES)
        meaning = " (averted: at rest after a squeeze)" if outcomes["averted"] else ""
        invalid = len(hung) - outcomes.total()
        left_out = f"; {counted(invalid, 'invalid trial')} left out" if invalid else ""
        sentences.append(f"Weights: {counts}{meaning}{left_out}.")
    kept = [r for r in hung if not r.get("invalid") and r["outcome"] in ("held", "averted")]
    if shown := _ratios(kept, "least_force_N"):
        by = "by the largest F_t/F_n that a trial showed over 5 ms"
        text = f"about {statistics.median(shown):.2f} or more {by}"
        if true := _ratios(kept, "least_force_true_N"):
            text += f", {statistics.median(true):.2f} by the simulation's coefficient of friction"
        sentences.append(
            f"Force used over the least that would have held: {text} (median of {len(shown)})."
        )
    return {"grip": sentences} if sentences else {}


def _ratios(readings: Sequence[Reading], least: str) -> list[float]:
    """Return the force used over the least that would have held, of the readings that have both."""
    return [
        float(used_N) / float(least_N)
        for one in readings
        if (used_N := one.get("force_used_N")) and (least_N := one.get(least))
    ]
