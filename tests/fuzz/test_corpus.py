"""Every example of the fuzzers' corpus: what was found once, and what they begin with."""

from __future__ import annotations

import pytest

from .targets import CORPUS, TARGETS


@pytest.mark.parametrize("target", TARGETS)
def test_no_example_of_the_corpus_breaks_its_target(target: str) -> None:
    examples = sorted((CORPUS / target).iterdir())
    assert examples
    for example in examples:
        TARGETS[target](example.read_bytes())
