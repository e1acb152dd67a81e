"""Trials for tuning and trials for reporting are never mixed."""

import pytest

from rig.core.errors import ConfigurationError
from rig.evaluation.scoring.seeds import SeedRange, check_unseen, check_use, seed_range

TUNING, REPORTING = seed_range("0:1000000"), seed_range("1000000:1000010")


def test_a_range_ends_before_its_end():
    assert list(seed_range(" 3:6 ").seeds()) == [3, 4, 5]


@pytest.mark.parametrize("text", ["", "5", "5:5", "6:5", "-1:5", "a:b", "1:2:3", "1e3:2e3"])
def test_what_is_no_range_is_refused(text):
    with pytest.raises(ConfigurationError, match="not a range of seeds"):
        seed_range(text)


def test_each_side_is_scored_for_what_it_is_for():
    check_use(TUNING, tuning=True)
    check_use(REPORTING, tuning=False)
    with pytest.raises(ConfigurationError, match="0:1000000 are reserved for tuning"):
        check_use(TUNING, tuning=False)
    with pytest.raises(ConfigurationError, match="are reserved for reporting"):
        check_use(REPORTING, tuning=True)


@pytest.mark.parametrize("tuning", [False, True])
def test_a_range_on_both_sides_is_refused_for_either_use(tuning):
    with pytest.raises(ConfigurationError, match="999999:1000001 lie on both sides of 1000000"):
        check_use(seed_range("999999:1000001"), tuning=tuning)


def test_what_has_seen_one_of_the_trials_is_not_scored_on_them():
    seen = SeedRange(first=1_000_009, end=1_000_012)
    with pytest.raises(ConfigurationError, match="net was tuned on seeds 1000009:1000012"):
        check_unseen("net", [SeedRange(first=0, end=9), seen], REPORTING)
    check_unseen("net", [SeedRange(first=1_000_010, end=1_000_012)], REPORTING)
    check_unseen("net", [], REPORTING)
