"""Groups of options that several commands share, as dataclasses.

A group is a dataclass that is marked with `option_group`. Each field whose type is `Annotated` is
an option. A command that is marked with `with_option_groups` and has a parameter of that class gets
these options in the place of the parameter, and is called with the object.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Annotated, Any, TypeVar, dataclass_transform, get_origin, get_type_hints

_MARK = "__option_group__"
Group = TypeVar("Group")


@dataclass_transform(kw_only_default=True, frozen_default=True)
def option_group(cls: type[Group]) -> type[Group]:
    """Return the class as a frozen dataclass with keyword arguments only, marked as a group."""
    setattr(cls, _MARK, True)
    return dataclass(frozen=True, kw_only=True)(cls)


def group_parameters(group: type) -> list[inspect.Parameter]:
    """Return one keyword-only parameter of a command for each option of a group."""
    hints = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=field.default,
            annotation=hints[field.name],
        )
        for field in fields(group)
        if get_origin(hints[field.name]) is Annotated
    ]


def with_option_groups(command: Callable[..., None]) -> Callable[..., None]:
    """Return the command with each parameter that is an option group replaced by its options."""
    signature = inspect.signature(command, eval_str=True)
    groups = {
        name: group_parameters(parameter.annotation)
        for name, parameter in signature.parameters.items()
        if getattr(parameter.annotation, _MARK, False)
    }

    @functools.wraps(command)
    def run(**given: Any) -> None:
        made = {
            name: signature.parameters[name].annotation(
                **{option.name: given.pop(option.name) for option in options}
            )
            for name, options in groups.items()
        }
        command(**given, **made)

    options = list(_options(signature, groups))
    run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    run.__annotations__ = {option.name: option.annotation for option in options}
    return run


def _options(
    signature: inspect.Signature, groups: dict[str, list[inspect.Parameter]]
) -> Iterator[inspect.Parameter]:
    for name, parameter in signature.parameters.items():
        if name in groups:
            yield from groups[name]
        else:
            yield parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY)
