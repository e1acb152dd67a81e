"""Settings: strict, frozen values whose field names carry their unit.

A settings class may hold other settings, numbers with a unit suffix (``speed_mm_s``), names and
flags. It may not read files, touch instruments or know where it is used. Unknown keys, NaN and
infinities are refused; pydantic collects every error of a document, so that all are shown at once
(``rig.core.errors.ConfigurationError.from_validation`` words them).
"""

from __future__ import annotations

import ast
import hashlib
import inspect
import json
import textwrap
from collections.abc import Iterator
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field

if TYPE_CHECKING:
    from pydantic import GetJsonSchemaHandler
    from pydantic.json_schema import JsonSchemaValue
    from pydantic_core import CoreSchema

UNIT_BY_SUFFIX: dict[str, str] = {
    "N_mV_V": "N/(mV/V)",
    "mV_V": "mV/V",
    "V_N": "V/N",
    "V_sqrtHz": "V/sqrt(Hz)",
    "C_N": "C/N",
    "N_V": "N/V",
    "N_mm": "N/mm",
    "mm_s2": "mm/s^2",
    "N_s": "N/s",
    "mm_s": "mm/s",
    "deg_s2": "deg/s^2",
    "deg_s": "deg/s",
    "dB_decade": "dB/decade",
    "S_s": "1/s",
    "kg_m3": "kg/m^3",
    "MPa": "MPa",
    "Pa": "Pa",
    "kN": "kN",
    "mN": "mN",
    "N": "N",
    "kHz": "kHz",
    "Hz": "Hz",
    "mV": "mV",
    "V": "V",
    "ms": "ms",
    "us": "us",
    "min": "min",
    "s": "s",
    "um": "um",
    "mm2": "mm^2",
    "mm": "mm",
    "m": "m",
    "deg": "deg",
    "rad": "rad",
    "dB": "dB",
    "pF": "pF",
    "F": "F",
    "ohm": "ohm",
    "C": "C",
    "percent": "percent",
}
"""Field-name suffix to unit, in the notation both pint and UDUNITS read."""

_SUFFIXES_LONGEST_FIRST = sorted(UNIT_BY_SUFFIX, key=len, reverse=True)


T = TypeVar("T")
WIRING, ADDRESS, MEANS = "wiring", "address", "means"
CHANNELS, COMMUNICATION_TIMEOUT, DECELERATION = "channels", "communication_timeout", "deceleration"
"""What a driver's setting means to the bench, by its mark."""

Wiring = Annotated[T, Field(json_schema_extra={WIRING: True})]
"""Type of a driver's setting that says where its instrument is, what is wired to it or how it
counts: ``port: Wiring[str]``. A dry run takes these from the simulated instrument and all others
from the bench file."""
Address = Annotated[T, Field(json_schema_extra={WIRING: True, ADDRESS: True})]
"""Type of a driver's setting that says where its instrument is: ``port: Address[str]``. It is
`Wiring` as well. The settings of this type together distinguish this instrument's link from all
others, as ``host`` and ``tcp_port`` do (`rig.bench.addresses`)."""
Channels = Annotated[T, Field(json_schema_extra={WIRING: True, MEANS: CHANNELS})]
"""Type of a DAQ's setting that has its inputs by signal: ``channels: Channels[dict[str, int]]``. It
is `Wiring` as well."""
CommunicationTimeout = Annotated[
    T, Field(json_schema_extra={WIRING: True, MEANS: COMMUNICATION_TIMEOUT})
]
"""Type of a stage's setting after which its drive stops by itself where nothing is sent to it, in s
or ms as its name ends: ``watchdog_ms: CommunicationTimeout[int]``. It is `Wiring` as well."""
Deceleration = Annotated[T, Field(json_schema_extra={MEANS: DECELERATION})]
"""Type of a stage's setting with which its drive brakes: ``deceleration_mm_s2:
Deceleration[float]``."""


class Settings(BaseModel):
    """Base of every settings class: unknown keys are refused, values are frozen, numbers finite."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        allow_inf_nan=False,
        validate_default=True,
    )

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Return the JSON schema, in which each field is described by the docstring below it."""
        made = handler(schema)
        properties = handler.resolve_ref_schema(made).get("properties", {})
        for name, text in descriptions(cls).items():
            properties.get(name, {}).setdefault("description", text)
        return made


def descriptions(model: type[Settings]) -> dict[str, str]:
    """Return the docstring below each field, by field name, including inherited fields.

    They are read from the source only when they are shown: pydantic would read the source of every
    settings class as it is imported, which takes longer than all else about them.
    """
    said: dict[str, str] = {}
    for cls in reversed(model.__mro__):
        if issubclass(cls, Settings) and cls is not Settings:
            said |= _attribute_docstrings(cls)
    return said


def _attribute_docstrings(cls: type[Settings]) -> dict[str, str]:
    try:
        source = inspect.getsource(cls)
    except OSError:  # A class that was typed in at a prompt has no source.
        return {}
    tree = ast.parse(textwrap.dedent(source))
    (body,) = (node.body for node in tree.body if isinstance(node, ast.ClassDef))
    return {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
        if isinstance(text.value.value, str)
    }


def wiring_of(model: type[Settings]) -> frozenset[str]:
    """Return the names of the settings whose type is marked as `Wiring` or `Address`."""
    return frozenset(_marked(model, WIRING))


def address_settings_of(model: type[Settings]) -> tuple[str, ...]:
    """Return the names of the settings whose type is marked as `Address`, in their order."""
    return tuple(_marked(model, ADDRESS))


def settings_that_mean(model: type[Settings], meaning: str) -> tuple[str, ...]:
    """Return the names of the settings whose type is marked with a meaning, such as `CHANNELS`."""
    return tuple(_marked(model, MEANS, meaning))


def _marked(model: type[Settings], mark: str, value: object = True) -> Iterator[str]:
    for name, field in model.model_fields.items():
        extra = field.json_schema_extra
        if isinstance(extra, dict) and extra.get(mark) == value:
            yield name


def unit_of(field_name: str) -> str | None:
    """Return the unit of a field from its name (``normal_force_N`` gives ``N``), or None."""
    for suffix in _SUFFIXES_LONGEST_FIRST:
        if field_name == suffix or field_name.endswith("_" + suffix):
            return UNIT_BY_SUFFIX[suffix]
    return None


def name_without_unit(field_name: str) -> str:
    """Return a field's name without its unit suffix: ``normal_force_N`` gives ``normal_force``."""
    for suffix in _SUFFIXES_LONGEST_FIRST:
        if field_name.endswith("_" + suffix):
            return field_name[: -len(suffix) - 1]
    return field_name


OPTION_HINTS = ("short", "only_with", "needs", "not_with")
"""What `json_schema_extra` of a field may say of its option: its letter, the value of another field
(or a list of values) without which it has no effect, the field that has to be given, and the one
with which it has none."""


def option_name(field_name: str) -> str:
    """Return the command-line option of a settings field: ``settling_s`` gives ``--settling``."""
    return "--" + name_without_unit(field_name).replace("_", "-")


def leaves(settings: Settings, prefix: str = "") -> Iterator[tuple[str, Any, str | None]]:
    """Yield every plain value of a settings tree as (dotted name, value, unit)."""
    for name in type(settings).model_fields:
        value = getattr(settings, name)
        if isinstance(value, Settings):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value, unit_of(name)


def fingerprint(*parts: Any) -> str:
    """Return a stable hash of JSON-able values and settings: equal exactly when they are equal."""
    plain = [p.model_dump(mode="json") if isinstance(p, BaseModel) else p for p in parts]
    text = json.dumps(plain, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
