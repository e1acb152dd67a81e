"""The report of ``rig score``: its files, its figures, and what it prints.

Nothing is written before everything has been computed, but its folder is made and kept for it.
"""

from __future__ import annotations

import csv
import json
import math
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from rig.cli.commands.score_tables import score_tables
from rig.cli.outcome import print_json, say
from rig.core.errors import (
    ConfigurationError,
    ExitCode,
    OutputError,
    RigError,
    SeveralFailuresError,
)

if TYPE_CHECKING:
    from rig.evaluation.scoring.contenders import Contender, Named
    from rig.evaluation.scoring.results import ContenderResult, ScoredTrial


def report(
    contenders: Sequence[Contender],
    judged: Sequence[ScoredTrial],
    use: str,
    simulated: bool,
    said: dict[str, Any],
    out: Path,
    as_json: bool,
    left_out: str = "",
) -> None:
    """Write tables and figures to `out` and print the tables.

    Trivial answers are scored with the detectors. `said` goes into the JSON file, `left_out`, the
    trials that are missing, into the heading of the tables. A detector of another package that
    failed is named and left out, and the exit code is then that of a command that finished with
    failures. Where no other is left, that failure is raised.
    """
    from rig.core.settings import fingerprint
    from rig.evaluation.scoring.results import ROW, results, rows, without_failed
    from rig.evaluation.scoring.trivial import with_trivial_answers

    contenders, judged, failures = without_failed(contenders, judged)
    if failures and not contenders:
        raise SeveralFailuresError([error for _, error in failures.values()])
    trivial, judged = with_trivial_answers(judged)
    named: list[Named] = [*contenders, *trivial]
    scored = results(named, judged)
    document = {
        "simulated": simulated,
        "use": use,
        "trials": len(judged),
        **said,
        "detectors": [
            {
                "name": one.name,
                **_identity(one),
                "parameters": fingerprint(one.settings),
                "tuned_on": ", ".join(map(str, one.tuned_on)) or None,
            }
            for one in contenders
        ],
        "failed_detectors": {
            name: f"{trial}: {error.one_line()}" for name, (trial, error) in failures.items()
        },
        "trivial_answers": [
            {"name": one.name, **one.settings.model_dump(mode="json")} for one in trivial
        ],
        "results": [dict(zip(ROW, map(_plain, row), strict=True)) for row in rows(scored, use)],
    }
    drawn = _draw(scored, use, simulated, out)
    _write_csv(out / "trials.csv", _TRIAL, _trials(named, judged))
    _write_csv(out / "score.csv", ROW, rows(scored, use))
    # Written last: its presence shows that the folder is complete.
    write(out / "score.json", json.dumps(document, indent=1) + "\n")
    if as_json:
        files = [out / name for name in ("score.json", "score.csv", "trials.csv")]
        print_json({**document, "files": [str(file) for file in [*files, *drawn]]})
        _end(failures)
        return
    heading = f"{'simulated trials, ' if simulated else ''}{use}, {len(judged)} trials"
    heading += f" ({left_out})" if left_out else ""
    for line in score_tables(scored, heading):
        typer.echo(line)
    figures = len({file.stem for file in drawn})
    typer.echo(
        f"saved in {out}: score.json, score.csv, trials.csv, {figures} figures (PNG and SVG)"
    )
    _end(failures)


def _end(failures: Mapping[str, tuple[str, RigError]]) -> None:
    """Name the detectors that are not in the tables because they failed, and end the command with
    the exit code for it."""
    for name, (trial, error) in failures.items():
        say(f"error: {name} is not in the tables: at {trial}, {error.one_line()}")
    if failures:
        raise typer.Exit(int(ExitCode.FINISHED_WITH_FAILURES))


_TRIAL = (
    "trial", "detector", "label", "found", "found_first", "early", "late", "alarmed",
    "alarmed_pressing", "alarmed_moving", "cannot_judge", "says_inverted",
    "slip_unjudged", "unjudged_s", "early_by_s", "after_node_s", "after_ridge_s",
    "before_gross_s", "armed", "arming_lead_s", "in_vain", "false_alarms",
    "without_slip_s", "quiet_alarms", "quiet_s", "kind", "stop", "pattern", "noise_mV",
    "speed_mm_s", "static_coefficient", "friction_ratio", "normal_force_N", "gain_mismatch",
    "tick_Hz", "held_share",
)  # fmt: skip


def _trials(
    contenders: Sequence[Named], judged: Sequence[ScoredTrial]
) -> Iterator[tuple[Any, ...]]:
    for trial in judged:
        for one, outcome in zip(contenders, trial.outcomes, strict=True):
            values = {"trial": trial.name, "detector": one.name, **outcome.traits, **vars(outcome)}
            yield tuple(values.get(name, "") for name in _TRIAL)


def _draw(scored: Sequence[ContenderResult], use: str, simulated: bool, out: Path) -> list[Path]:
    from rig.figures import score as figures
    from rig.figures.style import save

    title = f"{use}{', simulated' if simulated else ''}"
    drawn = {
        "score-found": figures.draw_found(scored, title),
        "score-delays": figures.draw_delays(scored, title),
    }
    if any(one.rocs for one in scored):
        drawn["score-roc"] = figures.draw_roc(scored, title)
    return [
        file
        for name, figure in drawn.items()
        for file in save(figure, out / f"{name}.png", simulated)
    ]


def _identity(contender: Contender) -> dict[str, Any]:
    """Return version and package of a detector; nothing of a baseline, which has none."""
    from rig.evaluation.scoring.contenders import DetectorContender

    if not isinstance(contender, DetectorContender):
        return {}
    detector = contender.detector
    return {
        "version": detector.version,
        "package": detector.package,
        "package_version": detector.package_version,
        "code": detector.code_digest or None,
    }


def _plain(value: Any) -> Any:
    """Return a value for JSON; numbers that are not finite become None."""
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def _write_csv(file: Path, head: Sequence[str], rows: Iterator[tuple[Any, ...]]) -> None:
    with _writing(file), file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(head)
        for row in rows:
            writer.writerow([_cell(value) for value in row])


def _cell(value: Any) -> Any:
    """Return a value for CSV: missing numbers are empty, flags 0 and 1."""
    if isinstance(value, bool):
        return int(value)
    plain = _plain(value)
    return "" if plain is None else plain


def write(file: Path, text: str) -> None:
    """Write a text file. Raises OutputError if it cannot be written."""
    with _writing(file):
        file.write_text(text, encoding="utf-8")


def check_no_score(out: Path) -> None:
    """Raise ConfigurationError for a folder that contains a score."""
    if (out / "score.json").exists():
        raise ConfigurationError(
            f"--out {out}: contains a score already",
            "choose a new folder; scores are not overwritten",
        )


@contextmanager
def reserved(out: Path) -> Iterator[None]:
    """Keep a folder for the score of this command while it is computed; it is made where it does
    not exist, and deleted where nothing has been written to it.

    Raises ConfigurationError where it contains a score or is kept for that of another command, and
    OutputError where it cannot be written to.
    """
    from rig.run.locks.lock import try_lock

    made = not out.exists()
    with _writing(out):
        out.mkdir(parents=True, exist_ok=True)
        folder = os.open(out, os.O_RDONLY | os.O_DIRECTORY)
    try:
        free = True
        with suppress(OSError):  # some file systems have no locks
            free = try_lock(folder)
        if not free:
            raise ConfigurationError(
                f"--out {out}: another rig score is running that will write there",
                "choose a different folder, or wait until it has ended",
            )
        check_no_score(out)  # that of a command which has ended meanwhile
        with _writing(out), tempfile.TemporaryFile(dir=out):
            pass
        yield
    finally:
        os.close(folder)
        if made:
            with suppress(OSError):  # it holds the score
                out.rmdir()


@contextmanager
def _writing(file: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(
            f"{file} cannot be written: {error.strerror}", "choose another place"
        ) from error
