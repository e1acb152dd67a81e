"""Expands a batch file to conditions with their settings, and to the queue of runs.

Pure: the same file gives the same conditions, ids and order, whatever the day or the computer.
Where a condition is wrong, the finding says at which part of the file it came from.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import product
from typing import Any, get_args, get_origin

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from rig.batch.plan.conditions import BatchCondition, BatchPlan, PlannedRun
from rig.batch.plan.findings import KeyPath, PlanFinding, RefusedBatchError
from rig.batch.plan.procedures import installed
from rig.batch.plan.settings import MOST_RUNS, BatchFile, Experiment, SpaceSample
from rig.core.errors import MOST_FINDINGS, ConfigurationError, finding, shortened
from rig.core.settings import Settings, name_without_unit, unit_of
from rig.core.units import parse
from rig.core.validated import validated

MOST_CONDITIONS = 100_000
"""Each has settings of its own; a night has time for fewer."""
MOST_COMPARISONS = 2_000_000
"""Limit on comparisons of combinations with entries of exclude and include."""
SHUFFLING, SAMPLING = 0, 1
"""Keys that make the random numbers of both uses of a seed independent."""


def expand(batch: BatchFile) -> BatchPlan:
    """Return the conditions of a batch and the queue of their runs; RefusedBatchError lists all
    that is wrong with any of them."""
    findings = list(check_defaults(batch.defaults))
    expanded = [
        Expansion(number, experiment, label, batch.defaults, batch.batch.seed)
        for (number, experiment), label in zip(
            enumerate(batch.experiment), labels(batch.experiment), strict=True
        )
    ]
    findings += _too_many(expanded)
    findings += _misplaced(batch)
    if not any(one.where == ("experiment",) for one in findings):
        for expansion in expanded:
            expansion.expand()
    findings += [one for expansion in expanded for one in expansion.findings]
    if findings:
        raise RefusedBatchError(findings)
    conditions = {c.id: c for expansion in expanded for c in expansion.conditions}
    return BatchPlan(conditions, tuple(_queue(batch, expanded)))


def labels(experiments: Sequence[Experiment]) -> list[str]:
    """Return the label with which the ids of each experiment's conditions begin: its name or its
    procedure, and a number if an earlier one has the same."""
    taken: dict[str, None] = {}
    for experiment in experiments:
        label = wanted = experiment.name or experiment.procedure
        number = 1
        while label in taken:
            number += 1
            label = f"{wanted}-{number}"
        taken[label] = None
    return list(taken)


def check_defaults(defaults: Mapping[str, Mapping[str, Any]]) -> Iterator[PlanFinding]:
    """Return the findings about [defaults] that do not depend on the experiments."""
    for name, table in defaults.items():
        try:
            model = installed(name).Settings
        except ConfigurationError as error:
            yield PlanFinding(("defaults", name), f"defaults: {error.message}", error.hint)
        else:
            converted = _SettingConverter(model)
            converted.table(table, ("defaults", name), f"defaults.{name}")
            yield from converted.findings


# --- one experiment ---------------------------------------------------------------------------


@dataclass
class _Combination:
    """Values of the matrix and the sample, and what include has added."""

    number: int
    """Place in the matrix, from 1; what is excluded keeps its place."""
    values: dict[str, Any]
    added: dict[str, tuple[Any, int]] = field(default_factory=dict)
    """Value, and the index of the entry of include that it comes from, by setting."""

    @property
    def varied(self) -> dict[str, Any]:
        return self.values | {name: value for name, (value, _) in self.added.items()}


class Expansion:
    """One experiment on its way to conditions."""

    def __init__(
        self,
        number: int,
        experiment: Experiment,
        label: str,
        defaults: Mapping[str, Mapping[str, Any]],
        seed: int,
    ):
        self.number, self.experiment, self.label = number, experiment, label
        self.where: KeyPath = ("experiment", number)
        self.conditions: list[BatchCondition] = []
        self.findings: list[PlanFinding] = []
        self._seed = seed
        self._defaults = defaults.get(experiment.procedure, {})
        self._model: type[Settings] | None = None
        self._matrix: dict[str, list[Any]] = {}
        """Values of the matrix by setting, in the settings' units."""
        self._places: dict[tuple[str, Any], int] = {}
        """Index of each value in its setting's list."""
        try:
            self._model = installed(experiment.procedure).Settings
        except ConfigurationError as error:
            self.findings.append(PlanFinding((*self.where, "procedure"), error.message, error.hint))

    @property
    def combinations(self) -> int:
        """Number of conditions at most."""
        experiment = self.experiment
        sizes = math.prod(len(values) for values in experiment.matrix.values())
        sampled = 1 if experiment.sample is None else experiment.sample.points
        return sizes * sampled + len(experiment.include)

    @property
    def comparisons(self) -> int:
        """Number of combinations that are compared with entries of exclude and include."""
        return self.combinations * (len(self.experiment.exclude) + len(self.experiment.include))

    @property
    def is_too_large(self) -> bool:
        """True if it is not to be expanded."""
        return self.combinations > MOST_CONDITIONS or self.comparisons > MOST_COMPARISONS

    def expand(self) -> None:
        """Make the conditions, or findings."""
        if self._model is None:
            return
        experiment, where = self.experiment, self.where
        converted = _SettingConverter(self._model, self.findings)
        defaults = _SettingConverter(self._model).table(self._defaults, (), "")
        own = converted.table(experiment.settings, (*where, "settings"), "settings")
        for name, values in experiment.matrix.items():
            if kept := self._values_of(converted, name, values):
                self._matrix[name] = kept
        excluded, included = (
            [
                converted.table(entry, (*where, table, number), table)
                for number, entry in enumerate(getattr(experiment, table))
            ]
            for table in ("exclude", "include")
        )
        for number, entry in enumerate(experiment.exclude):
            self.findings += [
                PlanFinding(
                    (*where, "exclude", number, name),
                    f"exclude.{shortened(name)}: the matrix does not vary it",
                    "exclude names combinations of the matrix",
                )
                for name in entry
                if name not in experiment.matrix
            ]
        sample = experiment.sample if self._is_sampled_well(experiment.sample) else None
        combinations = self._combined(sample, excluded, included)
        self._validate(self._model, {**defaults, **own}, combinations)
        if not self.conditions and not self.findings:
            self.findings.append(
                PlanFinding(where, "no combination is left to run", "exclude fewer of them")
            )

    def _values_of(
        self, converted: _SettingConverter, name: str, values: Sequence[Any]
    ) -> list[Any]:
        """Return the values of a setting in the matrix: at least one, each once."""
        where, setting = (*self.where, "matrix", name), f"matrix.{shortened(name)}"
        if not values:
            self.findings.append(
                PlanFinding(where, f"{setting}: has no value", "give at least one")
            )
        kept: dict[Any, Any] = {}
        for number, value in enumerate(values):
            one = converted.one(name, value, (*where, number), setting)
            if one is _WRONG:
                continue
            if _same(one) in kept:
                self.findings.append(
                    PlanFinding(
                        (*where, number),
                        f"{setting} = {shortened(repr(value))}: appears twice in the list",
                        "repeat = 2 runs each condition twice",
                    )
                )
            kept[_same(one)] = one
            self._places[name, _same(one)] = number
        return list(kept.values())

    def _is_sampled_well(self, sample: SpaceSample | None) -> bool:
        """Return whether every range is one of a number that nothing else varies."""
        if sample is None:
            return True
        assert self._model is not None
        before = len(self.findings)
        for name, (low, high) in sample.ranges.items():
            where = (*self.where, "sample", "ranges", name)
            setting = f"sample.ranges.{shortened(name)}"
            info = self._model.model_fields.get(name)
            if info is None:
                self.findings.append(_unknown(self._model, name, setting, where))
            elif name in self.experiment.matrix:
                self.findings.append(
                    PlanFinding(
                        where, f"{setting}: the matrix varies it, too", "leave it in one of them"
                    )
                )
            elif _number(info) is None:
                self.findings.append(
                    PlanFinding(
                        where, f"{setting}: is not a number", "list its values in matrix instead"
                    )
                )
            elif not math.isfinite(high - low) or (
                name in sample.log and not math.isfinite(high / low)
            ):
                self.findings.append(
                    PlanFinding(where, f"{setting}: {low:g} to {high:g} is too wide", "narrow it")
                )
        return len(self.findings) == before

    def _combined(
        self,
        sample: SpaceSample | None,
        excluded: Sequence[Mapping[str, Any]],
        included: Sequence[Mapping[str, Any]],
    ) -> list[_Combination]:
        """Return the combinations, without those to leave out, with what is added to them: as the
        matrices of GitHub Actions."""
        matrix = self._matrix
        sampled = [{}] if sample is None else self._sampled(sample)
        whole = (
            {**dict(zip(matrix, values, strict=True)), **point}
            for values in product(*matrix.values())
            for point in sampled
        )
        originals: list[_Combination] = []
        number = 0
        if matrix or sample is not None or not included:
            for number, values in enumerate(whole, 1):
                if not any(_has_all(values, entry) for entry in excluded):
                    originals.append(_Combination(number, values))
        further: list[_Combination] = []
        for k, entry in enumerate(included):
            added = {name: (value, k) for name, value in entry.items()}
            fitting = [c for c in originals if _has_all(c.values, entry, or_lacks=True)]
            for combination in fitting:
                combination.added |= {
                    name: value for name, value in added.items() if name not in combination.values
                }
            if not fitting:
                further.append(_Combination(number + len(further) + 1, {}, added))
        return originals + further

    def _sampled(self, sample: SpaceSample) -> list[dict[str, Any]]:
        """Return the points of a sample, each a value by setting."""
        import numpy as np
        from scipy.stats import qmc

        assert self._model is not None
        rng = np.random.default_rng([self._seed, SAMPLING, self.number])
        size = len(sample.ranges)
        if sample.method == "sobol":  # of a power of two as many as are wanted: no warning then
            points = qmc.Sobol(size, rng=rng).random_base2(math.ceil(math.log2(sample.points)))
            points = points[: sample.points]
        else:
            points = qmc.LatinHypercube(size, rng=rng).random(sample.points)
        columns: dict[str, list[Any]] = {}
        for share, (name, (low, high)) in zip(points.T, sample.ranges.items(), strict=True):
            if name in sample.log:
                values = low * (high / low) ** share
            else:
                values = low + (high - low) * share
            if _number(self._model.model_fields[name]) is int:
                columns[name] = [round(float(value)) for value in values]
            else:  # as many digits as anybody reads, within the range all the same
                short = [float(f"{value:.6g}") for value in values]
                columns[name] = [min(max(value, low), high) for value in short]
        rows = zip(*columns.values(), strict=True)
        return [dict(zip(columns, values, strict=True)) for values in rows]

    # --- what the procedure says of them --------------------------------------------------------

    def _validate(
        self,
        model: type[Settings],
        base: Mapping[str, Any],
        combinations: Sequence[_Combination],
    ) -> None:
        for combination in combinations:
            varied = combination.varied
            name = f"{self.label}-{combination.number:03d}"
            try:
                settings = validated(model, {**base, **varied}).model_dump(mode="json")
            except ValidationError as error:
                self._refuse(error, name, combination)
                if len(set(self.findings)) > MOST_FINDINGS:
                    return  # no more are reported
                continue
            self.conditions.append(
                BatchCondition(
                    id=name,
                    experiment=self.number,
                    procedure=self.experiment.procedure,
                    settings=settings,
                    varied={field: settings[field] for field in varied},
                    reference=self.experiment.every is not None,
                    rest_s=self.experiment.rest_s,
                )
            )

    def _refuse(self, error: ValidationError, name: str, combination: _Combination) -> None:
        for item in error.errors():
            if item["loc"]:
                where, table = self._origin(str(item["loc"][0]), combination)
                problem = finding({**item, "loc": (*table, *item["loc"])})
            else:
                shown = ", ".join(
                    f"{field} = {shortened(str(value))}"
                    for field, value in combination.varied.items()
                )
                where = self.where
                problem = f"{name}{f' ({shown})' if shown else ''}: {finding(item)}"
            self.findings.append(PlanFinding(where, problem, _see(self.experiment.procedure)))

    def _origin(self, name: str, combination: _Combination) -> tuple[KeyPath, tuple[str, ...]]:
        """Return the place in the file from which a combination has its value of a setting."""
        own, experiment = self.where, self.experiment
        if name in combination.added:
            return (*own, "include", combination.added[name][1], name), ("include",)
        if name in experiment.matrix:
            if name not in combination.values:  # of a combination that include has made
                return (*own, "matrix", name), ("matrix",)
            place = self._places[name, _same(combination.values[name])]
            return (*own, "matrix", name, place), ("matrix",)
        if experiment.sample is not None and name in experiment.sample.ranges:
            return (*own, "sample", "ranges", name), ("sample",)
        if name in experiment.settings:
            return (*own, "settings", name), ("settings",)
        if name in self._defaults:
            return ("defaults", experiment.procedure, name), ("defaults", experiment.procedure)
        return own, ()


_WRONG: Any = object()
"""Stands for a value that a finding has reported."""


class _SettingConverter:
    """Values of settings in the settings' own units, and findings of those that are none."""

    def __init__(self, model: type[Settings], findings: list[PlanFinding] | None = None):
        self.findings: list[PlanFinding] = [] if findings is None else findings
        self._model = model

    def table(self, table: Mapping[str, Any], where: KeyPath, place: str) -> dict[str, Any]:
        """Return the settings of a table without the wrong ones. `place` names the table in
        findings."""
        converted = {
            name: self.one(name, value, (*where, name), f"{place}.{shortened(name)}")
            for name, value in table.items()
        }
        return {name: value for name, value in converted.items() if value is not _WRONG}

    def one(self, name: str, value: Any, where: KeyPath, setting: str) -> Any:
        """Return a single one; _WRONG where it is wrong."""
        info = self._model.model_fields.get(name)
        if info is None:
            self.findings.append(_unknown(self._model, name, setting, where))
            return _WRONG
        try:
            return _in_own_unit(value, info.annotation, unit_of(name))
        except ValueError as error:
            self.findings.append(
                PlanFinding(where, f"{setting} = {shortened(repr(value))}: {error}")
            )
            return _WRONG


def _in_own_unit(value: Any, annotation: Any, unit: str | None) -> Any:
    """Return a value as settings take it: text as on the command line, alone or in a list."""
    if isinstance(value, str):
        return parse(value, annotation, unit)
    if isinstance(value, list) and get_origin(annotation) is tuple:
        return tuple(_in_own_unit(item, get_args(annotation)[0], unit) for item in value)
    return value


def _unknown(model: type[Settings], name: str, setting: str, where: KeyPath) -> PlanFinding:
    fields = list(model.model_fields)
    near = [field for field in fields if name_without_unit(field) == name]
    near = near or get_close_matches(shortened(name), fields, 1)
    hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(fields)}"
    return PlanFinding(where, f"{setting}: the procedure has no such setting", hint)


def _see(procedure: str) -> str:
    return f"see rig {procedure} --help"


def _number(info: FieldInfo) -> type | None:
    """`int` or `float` for a setting that can be spread over a range."""
    if info.annotation is int:
        return int
    return float if float in (info.annotation, *get_args(info.annotation)) else None


def _same(value: Any) -> tuple[bool, Any]:
    """Equal for equal values: true is not 1."""
    return isinstance(value, bool), value


def _has_all(values: Mapping[str, Any], entry: Mapping[str, Any], or_lacks: bool = False) -> bool:
    """Return whether a combination has every value of an entry; with `or_lacks`, contradicts
    none."""
    return all(
        _same(values[name]) == _same(value) if name in values else or_lacks
        for name, value in entry.items()
    )


# --- the queue --------------------------------------------------------------------------------


def _too_many(expanded: Sequence[Expansion]) -> Iterator[PlanFinding]:
    """Return the reason why a batch is too large to be expanded."""
    others = references = conditions = 0
    hint = "make the matrix smaller, or two batches of it"
    for expansion in expanded:
        experiment, combinations = expansion.experiment, expansion.combinations
        conditions += combinations
        others += combinations * experiment.repeat if experiment.every is None else 0
        if expansion.comparisons > MOST_COMPARISONS:
            yield PlanFinding(
                ("experiment",),
                f"experiment {expansion.number + 1}: {combinations} combinations are too many for "
                f"so many entries of exclude and include ({MOST_COMPARISONS} pairs at most)",
                "leave combinations out of the matrix itself",
            )
    for expansion in expanded:
        if expansion.experiment.every is not None:
            references += 1 + math.ceil(others / expansion.experiment.every)
    if conditions > MOST_CONDITIONS:
        yield PlanFinding(
            ("experiment",), f"{conditions} conditions are more than {MOST_CONDITIONS}", hint
        )
    if others + references > MOST_RUNS:
        yield PlanFinding(
            ("experiment",), f"{others + references} runs are more than {MOST_RUNS}", hint
        )


def _misplaced(batch: BatchFile) -> Iterator[PlanFinding]:
    """Yield the settings of the queue that have no effect."""
    alone = all(experiment.every is not None for experiment in batch.experiment)
    for number, experiment in enumerate(batch.experiment):
        where = ("experiment", number)
        if alone:
            yield PlanFinding(
                (*where, "every"),
                f"every = {experiment.every}: a reference runs between others, and there are none",
                "leave every out",
            )
        if not experiment.block_by:
            continue
        if batch.batch.order != "blocked":
            yield PlanFinding(
                (*where, "block_by"),
                f"block_by has no meaning with order = {batch.batch.order!r}",
                'set order = "blocked" in [batch], or leave block_by out',
            )
        sampled = experiment.sample.ranges if experiment.sample is not None else {}
        included = {name for entry in experiment.include for name in entry}
        for name in experiment.block_by:
            if name not in experiment.matrix and name not in sampled and name not in included:
                yield PlanFinding(
                    (*where, "block_by"),
                    f"block_by: {shortened(name)} is not varied",
                    "name settings of the matrix",
                )


def _queue(batch: BatchFile, expanded: Sequence[Expansion]) -> Iterator[PlannedRun]:
    """Yield the runs in their order, references among them, numbered."""
    others = [e for e in expanded if e.experiment.every is None]
    references = [(e.experiment.every, e) for e in expanded if e.experiment.every is not None]
    queue = _ordered(batch, others)
    repeats = dict.fromkeys((e.number for _, e in references), 0)
    number = 0
    for done in range(len(queue) + 1):
        for every, expansion in references:
            if done % every == 0 or done == len(queue):
                number, repeats[expansion.number] = number + 1, repeats[expansion.number] + 1
                (condition,) = expansion.conditions
                yield PlannedRun(number, condition.id, repeats[expansion.number])
        if done < len(queue):
            number += 1
            yield PlannedRun(number, *queue[done])


def _ordered(batch: BatchFile, expanded: Sequence[Expansion]) -> list[tuple[str, int]]:
    """Return the condition and repeat of every run that is not a reference, in the order asked for.

    As written: experiment by experiment, its whole matrix once, then again for each repeat.
    Blocked: the blocks of all experiments in random order, the runs of each shuffled.
    """
    import numpy as np

    blocks: dict[Any, list[tuple[str, int]]] = {}
    for expansion in expanded:
        experiment = expansion.experiment
        for repeat in range(1, experiment.repeat + 1):
            for condition in expansion.conditions:
                values = tuple(repr(condition.settings[name]) for name in experiment.block_by)
                block = (expansion.number, values or repeat)
                blocks.setdefault(block, []).append((condition.id, repeat))
    rng = np.random.default_rng([batch.batch.seed, SHUFFLING])
    queue = list(blocks.values())
    if batch.batch.order == "as-written":
        return [run for block in queue for run in block]
    if batch.batch.order == "shuffled":
        queue = [[run for block in queue for run in block]]
    return [
        queue[b][k] for b in rng.permutation(len(queue)) for k in rng.permutation(len(queue[b]))
    ]
