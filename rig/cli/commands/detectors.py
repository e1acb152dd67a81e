"""``rig detectors``: the detectors that can be chosen, and from which packages they come."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rig.cli.options.shared import AsJson, Debug
from rig.cli.outcome import print_json, reported, say
from rig.core.errors import RigError
from rig.core.text import printable
from rig.detector import DEFAULT_DETECTOR

if TYPE_CHECKING:
    from rig.detector.registered import ChosenDetector


def detectors(
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List the detectors of incipient slip that are installed."""
    with reported(debug, as_json):
        from rig.detector.registered import chosen_detector, detector_names

        usable: list[ChosenDetector] = []
        broken: dict[str, str] = {}
        for name in detector_names():
            try:
                usable.append(chosen_detector(name))
            except RigError as error:  # one that is broken disables only itself
                broken[name] = error.one_line()
                say(f"warning: {printable(broken[name])}")
        if as_json:
            print_json(_as_object(usable, broken))
            return
        widths = [max(map(len, column)) for column in zip(*map(_cells, usable), strict=True)]
        for one in usable:
            cells = [cell.ljust(width) for cell, width in zip(_cells(one), widths, strict=True)]
            print(printable("  ".join([*cells, _summary(one)])))  # noqa: T201 - data


def _cells(one: ChosenDetector) -> tuple[str, str, str]:
    """Return name, version and package of a detector, as they stand in its line."""
    name = f"{one.name} (default)" if one.name == DEFAULT_DETECTOR else one.name
    return name, one.version, f"{one.package} {one.package_version}"


def _summary(one: ChosenDetector) -> str:
    return (one.kind.__doc__ or "").strip().split("\n", 1)[0]


def _as_object(usable: list[ChosenDetector], broken: dict[str, str]) -> dict[str, object]:
    return {
        "detectors": [
            {
                "name": one.name,
                "version": one.version,
                "package": one.package,
                "package_version": one.package_version,
                "default": one.name == DEFAULT_DETECTOR,
                "summary": _summary(one),
                "settings": one.settings.model_dump(mode="json", exclude={"network"}),
                "rates_Hz": [one.kind.slowest_Hz, one.kind.fastest_Hz],
            }
            for one in usable
        ],
        "broken": broken,
    }
