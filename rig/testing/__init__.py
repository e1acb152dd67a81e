"""The contracts of drivers and detectors as a test kit, for any package.

A test module of a driver's package needs two lines in addition to its imports::

    from rig.testing import driver_contract

    test_acme_f10 = driver_contract("acme-f10", core=F10Core, settings={"max_force_N": 40.0})

pytest then runs every check of the contract against the driver, which talks over its real link to
its own simulator, in whatever role. Only a driver with a simulator that needs more than its core
has a subclass of `Case` and `contract_of`.

A detector's package has one line: ``test_contract = detector_contract("lab-jump")``.

The kit is used inside a pytest run and nowhere else: it knows no driver and no simulator of its
own, and nothing of the program imports it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import Any

from rig.testing.case import STRANGER, TIMEOUT_S, BenchClock, Case, Service

__all__ = [
    "STRANGER",
    "TIMEOUT_S",
    "BenchClock",
    "Case",
    "Service",
    "contract_of",
    "detector_contract",
    "driver_contract",
]

ContractTest = Callable[..., None]
"""A test function: pytest collects it where its name in the module begins with ``test_``."""


def driver_contract(
    driver: str,
    *,
    core: Any,
    settings: Mapping[str, Any] | None = None,
    silent_first_request: str = "",
    force_scale: float = 1.0,
    travel: tuple[float, float] | None = None,
    no_identity: str = "",
) -> ContractTest:
    """Return a pytest test that puts the installed driver `driver` through its role's contract.

    `core` is the class of its simulator, which derives from the core of a role; `settings` are the
    keys of the bench file's table for the driver beyond those of its `bench_settings`.
    `silent_first_request` is the reason why a lost answer to the very first request may go
    unnoticed, where a driver has such a reason. A force sensor is pressed with 5 N along z, rising
    to about 10 N; `force_scale` scales that for another range. `travel` is how far a stage may
    move, in mm or deg, for its `bench_settings`; the usual one of the simulated bench unless given.
    `no_identity` is the reason why the instrument cannot be distinguished from another one, where
    there is such a reason, for example that no request asks for its name: then that another
    instrument is refused is left out.
    """
    from rig.testing.core_case import CoreCase

    return contract_of(
        CoreCase(driver, core, settings, silent_first_request, force_scale, travel, no_identity)
    )


def contract_of(*cases: Case, further_deals: Collection[int] = ()) -> ContractTest:
    """Return a pytest test that puts each case's driver through every check of the contract.

    The test has one parameter set for each check of each case, named ``case-check``. In the check
    of faults each request of an experiment meets one of five kinds. With `further_deals`, numbers
    from 1 to 4, the test has only that many walks instead, in each of which every request meets
    another kind; all four take minutes.
    """
    import pytest

    from rig.testing.checks import checks_of, further_walks_of

    def chosen(case: Case) -> Mapping[str, Callable[[Case], None]]:
        return further_walks_of(case, further_deals) if further_deals else checks_of(case)

    each = [
        pytest.param(case, check, id=f"{case}-{name}")
        for case in cases
        for name, check in chosen(case).items()
    ]

    @pytest.mark.parametrize(("case", "check"), each)
    def contract(case: Case, check: Callable[[Case], None]) -> None:
        check(case)

    return contract


def detector_contract(name: str) -> ContractTest:
    """Return a pytest test that puts the installed detector `name` through what every detector has
    to fulfil (`rig.testing.detectors`), with one parameter set for each check."""
    import pytest

    from rig.testing.detectors import checks_of

    each = [pytest.param(check, id=what) for what, check in checks_of(name).items()]

    @pytest.mark.parametrize("check", each)
    def contract(check: Callable[[], None]) -> None:
        check()

    return contract
