"""Settings on the command line: one option per field, ``normal_force_N`` as ``--normal-force 4N``.

A value may be a bare number in the field's own unit or carry any unit that converts to it
(``--settling 200ms``). Lists are separated by commas.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, get_args, get_origin

import typer
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from rig.core.errors import ConfigurationError, finding
from rig.core.settings import Settings, descriptions, option_name, unit_of
from rig.core.units import parse
from rig.core.validated import validated
from rig.run.bench_selector import require_variant, simulated_variants

STATED_DEFAULT = "Default: "
"""Words in the docstring of a setting before a default that is not a value."""


def _variant(name: str | None) -> str | None:
    """Return the name of an installed variant of the simulated bench, or None for the usual one."""
    try:
        return None if name is None else require_variant(name)
    except ValueError as error:
        raise typer.BadParameter(f"{name!r} {error}") from None


def _variants() -> str:
    """Return the choices as a help text shows them; a simulated bench that is broken says so when
    it is started."""
    try:
        return f"[{'|'.join(simulated_variants())}]"
    except (ImportError, ConfigurationError):
        return "NAME"


SimulatedStages = Annotated[
    str | None,
    typer.Option(
        "--stages",
        callback=_variant,
        metavar=_variants(),
        help="Stages z and x of a simulated bench.  [default: the first of these]",
    ),
]
"""The option ``--stages`` of the commands that can start a simulated bench."""


def parameters(model: type[Settings]) -> list[inspect.Parameter]:
    """Return the command parameters for a settings class: all optional texts, validated by the
    class. One that is given twice brings two texts, for `texts_of`."""
    said = descriptions(model)
    return [
        inspect.Parameter(
            field,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                bool | None if info.annotation is bool else list[str] | None,
                typer.Option(
                    _switch(field) if info.default is True else option_name(field),
                    *_short(info),
                    help=_help(field, info, said.get(field, "")),
                    metavar=_metavar(field, info),
                    show_default=False,
                    rich_help_panel="Settings",
                ),
            ],
        )
        for field, info in model.model_fields.items()
    ]


def _metavar(field: str, info: FieldInfo) -> str:
    """Return what stands for the value in the help: its choices, else its unit, else LIST, NAME,
    COUNT or NUMBER."""
    if get_origin(info.annotation) is Literal:
        return f"[{'|'.join(str(choice) for choice in get_args(info.annotation))}]"
    if unit := unit_of(field):
        return unit
    if _is_list(info):
        return "LIST"
    if info.annotation is str:
        return "NAME"
    is_count = info.annotation is int and not field.endswith("seed")
    return "COUNT" if is_count else "NUMBER"


def texts_of(model: type[Settings], given: Mapping[str, list[str] | bool | None]) -> dict[str, str]:
    """Return one text for each option that was given, "true" or "false" for a switch. A list that
    is given in several parts is one list; of any other option that is given twice the last one
    holds, as is usual in a shell."""
    return {
        field: _text_of(model.model_fields[field], parts)
        for field, parts in given.items()
        if parts is not None and parts != []
    }


def _switch(field: str) -> str:
    """Return the option of a switch that is on by default, with the one that turns it off."""
    on = option_name(field)
    return f"{on}/--no-{on.removeprefix('--')}"


def _text_of(info: FieldInfo, parts: list[str] | bool) -> str:
    if isinstance(parts, bool):
        return str(parts).lower()
    return ",".join(parts) if _is_list(info) else parts[-1]


def _is_list(info: FieldInfo) -> bool:
    return tuple in (get_origin(info.annotation), *map(get_origin, get_args(info.annotation)))


def settings_from(model: type[Settings], given: Mapping[str, str | None]) -> Settings:
    """Return validated settings from option texts.

    ConfigurationError reports everything that is wrong. An option that has no effect together with
    the others is refused (`_needs`, `_excluded_by`).
    """
    values: dict[str, Any] = {}
    findings: list[str] = []
    for field, text in given.items():
        if text is None:
            continue
        try:
            values[field] = parse(text, model.model_fields[field].annotation, unit_of(field))
        except ValueError as error:
            findings.append(f"{option_name(field)} {text or repr(text)}: {error}")
    if findings:
        raise ConfigurationError("; ".join(findings), "see --help for the units")
    try:
        settings = validated(model, values)
    except ValidationError as error:
        items = error.errors()
        places = [item["loc"] for item in items]
        findings = [
            _refused(model, given, item)
            for item in items  # a list of which a value is refused is also said to be too short
            if not any(other[:-1] == item["loc"] and other for other in places)
        ]
        raise ConfigurationError("; ".join(findings), "see --help for the settings") from error
    for field in values:
        option, info = f"{option_name(field)} {given[field]}", model.model_fields[field]
        for other, effective in _needs(info):
            is_now = str(getattr(settings, other))
            if is_now not in effective:
                so = "" if effective == ["True"] else f", and {option_name(other)} is {is_now}"
                raise ConfigurationError(
                    f"{option} has an effect only with {_as_given(other, effective)}{so}",
                    f"leave it out, or add {_as_given(other, effective)}",
                )
        if (other := _needed_field(info)) and not getattr(settings, other):
            raise ConfigurationError(
                f"{option} has an effect only with {option_name(other)}",
                f"leave it out, or add {option_name(other)}",
            )
        if (other := _excluded_by(info)) in values:
            raise ConfigurationError(
                f"{option} cannot be combined with {option_name(other)}", "leave one of them out"
            )
    return settings


def _refused(model: type[Settings], given: Mapping[str, str | None], item: Any) -> str:
    """One of pydantic's findings as a person gave it: ``--trials 0: must be at least 1``."""
    names = {field: option_name(field) for field in model.model_fields}
    field = str(item["loc"][0]) if item["loc"] else ""
    message = finding(item)
    if field in names:
        message = message.rpartition(": ")[2] if ": " in message else message
        message = f"{names[field]} {given.get(field) or ''}".rstrip() + f": {message}"
    # A name without an underscore, such as `object`, is an English word as well.
    fields = [name for name in sorted(names, key=len, reverse=True) if "_" in name]
    words = r"(?<![\w-])(" + "|".join(fields) + r")\b"
    if fields:
        message = re.sub(words, lambda match: names[match[1]], message)
    return message


def _short(info: FieldInfo) -> tuple[str, ...]:
    """Return the letter that a field asks for, as ``json_schema_extra={"short": "-n"}``."""
    extra = info.json_schema_extra
    return (str(extra["short"]),) if isinstance(extra, dict) and "short" in extra else ()


def _needs(info: FieldInfo) -> list[tuple[str, list[str]]]:
    """Return the field, with its values, without which another has no effect: stated there as
    ``json_schema_extra={"only_with": {"loading": "ramp"}}``, or with a list of values."""
    extra = info.json_schema_extra
    stated = extra.get("only_with") if isinstance(extra, dict) else None
    if not isinstance(stated, dict):
        return []
    return [
        (field, list(map(str, value if isinstance(value, list) else [value])))
        for field, value in stated.items()
    ]


def _needed_field(info: FieldInfo) -> str:
    """Return the field that has to be given so that another has an effect, stated there as
    ``json_schema_extra={"needs": "loads_N"}``; "" if there is none."""
    extra = info.json_schema_extra
    return str(extra.get("needs", "")) if isinstance(extra, dict) else ""


def _as_given(field: str, values: list[str]) -> str:
    """Return an option with its value as a person gives it, or several; a switch has none."""
    name = option_name(field)
    return name if values == ["True"] else f"{name} {' or '.join(values)}"


def _excluded_by(info: FieldInfo) -> str:
    """Return the field with which another has no effect, stated there as
    ``json_schema_extra={"not_with": "frequencies_Hz"}``; "" if there is none."""
    extra = info.json_schema_extra
    return str(extra.get("not_with", "")) if isinstance(extra, dict) else ""


def _help(field: str, info: FieldInfo, said: str) -> str:
    """Return what an option is for, with what it needs, its default and its range. A docstring may
    end with a default in words, ``Default: 100 Hz, or what the stages allow.``"""
    words, _, in_words = " ".join(said.split()).partition(STATED_DEFAULT)
    words = words.rstrip()
    for other, effective in _needs(info):
        words = f"{words} Only with {_as_given(other, effective)}."
    if other := _needed_field(info):
        words = f"{words} Only with {option_name(other)}."
    if other := _excluded_by(info):
        words = f"{words} Not with {option_name(other)}."
    default = info.get_default(call_default_factory=True)
    facts = []
    if default is not None and default is not False and default not in ("", ()):
        if isinstance(default, tuple):
            shown = ", ".join(map(str, default))
            if all(isinstance(value, (int, float)) for value in default):
                shown = f"{len(default)} values, {default[0]:g} to {default[-1]:g}"
        elif default is True:
            shown = "on"
        else:
            shown = f"{default:g}" if isinstance(default, float) else str(default)
        facts.append(f"default: {shown} {unit_of(field) or ''}".rstrip())
    elif in_words:
        facts.append(f"default: {in_words.removesuffix('.')}")
    if within := _range(info):
        facts.append(within)
    return f"{words}  [{'; '.join(facts)}]" if facts else words


def _range(info: FieldInfo) -> str:
    """Return in words what a number of the field may be; "" where nothing is stated."""
    bounds = {
        name: getattr(constraint, name)
        for constraint in info.metadata
        for name in ("gt", "ge", "lt", "le")
        if hasattr(constraint, name)
    }
    if "ge" in bounds and "le" in bounds:
        return f"{bounds['ge']:g} to {bounds['le']:g}"
    words = {"gt": "above", "ge": "at least", "lt": "below", "le": "at most"}
    return ", ".join(f"{words[name]} {value:g}" for name, value in bounds.items())
