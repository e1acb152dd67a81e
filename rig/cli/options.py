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
from rig.run.bench_selector import require_variant, simulated_variants


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
        help="Stages z and x of a simulated bench; by default the first of these.",
    ),
]
"""The option ``--stages`` of the commands that can start a simulated bench."""


def parameters(model: type[Settings]) -> list[inspect.Parameter]:
    """Command parameters for a settings class: all optional text, validated by the class."""
    said = descriptions(model)
    return [
        inspect.Parameter(
            field,
            inspect.Parameter.KEYWORD_ONLY,
            default=None,
            annotation=Annotated[
                str | None,
                typer.Option(
                    option_name(field),
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
    """Return what stands for the value in the help: its choices, else its unit, else VALUE."""
    if get_origin(info.annotation) is Literal:
        return f"[{'|'.join(str(choice) for choice in get_args(info.annotation))}]"
    return unit_of(field) or "VALUE"


def settings_from(model: type[Settings], given: Mapping[str, str | None]) -> Settings:
    """Validated settings from option texts; ConfigurationError reports everything that is wrong."""
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
        return model.model_validate(values)
    except ValidationError as error:
        findings = [_refused(model, given, item) for item in error.errors()]
        raise ConfigurationError("; ".join(findings), "see --help for the settings") from error


def _refused(model: type[Settings], given: Mapping[str, str | None], item: Any) -> str:
    """One of pydantic's findings as a person gave it: ``--trials 0: must be at least 1``."""
    names = {field: option_name(field) for field in model.model_fields}
    field = str(item["loc"][0]) if item["loc"] else ""
    message = finding(item)
    if field in names:
        message = message.rpartition(": ")[2] if ": " in message else message
        message = f"{names[field]} {given.get(field) or ''}".rstrip() + f": {message}"
    words = r"(?<![\w-])(" + "|".join(sorted(names, key=len, reverse=True)) + r")\b"
    message = re.sub(words, lambda match: names[match[1]], message)
    return message.replace("has to be", "must be")


def _short(info: FieldInfo) -> tuple[str, ...]:
    """Return the letter that a field asks for, as ``json_schema_extra={"short": "-n"}``."""
    extra = info.json_schema_extra
    return (str(extra["short"]),) if isinstance(extra, dict) and "short" in extra else ()


def _help(field: str, info: FieldInfo, said: str) -> str:
    words = " ".join(said.split())
    default = info.get_default(call_default_factory=True)
    if default is None or default in ("", ()):
        return words
    if isinstance(default, tuple):
        shown = f"{len(default)} values, {default[0]:g} to {default[-1]:g}"
    else:
        shown = f"{default:g}" if isinstance(default, float) else str(default)
    unit = unit_of(field)
    return f"{words} [{shown}{' ' + unit if unit else ''}]"
