"""Fuzzes one target with atheris, guided by coverage.

    python -m venv --system-site-packages /tmp/fuzz && /tmp/fuzz/bin/pip install atheris
    PYTHONPATH=.:tests /tmp/fuzz/bin/python -m fuzz.fuzz units -max_total_time=600

With the environment of the project on its path. Further arguments are libFuzzer's. An input that
breaks a target is written to the current folder as ``crash-...``: make it an example of the corpus,
`tests/fuzz/corpus/TARGET/`, which the default tier replays, when the defect is mended.
"""

from __future__ import annotations

import sys
import tempfile

import atheris  # type: ignore[import-not-found]

with atheris.instrument_imports(include=["rig", "drivers"]):
    from fuzz.targets import CORPUS, TARGETS


def main() -> None:
    """Fuzz the target that the command line names."""
    name, *rest = sys.argv[1:]
    with tempfile.TemporaryDirectory() as found:  # libFuzzer keeps in the first what is new to it
        atheris.Setup([sys.argv[0], *rest, found, str(CORPUS / name)], TARGETS[name])
        atheris.Fuzz()


if __name__ == "__main__":
    main()
