"""One contract for all drivers: every role method, every documented error, no wrong value ever."""

from __future__ import annotations

import inspect
import zlib
from bisect import bisect_right
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from pydantic import ValidationError

from rig.core.errors import InstrumentError, InstrumentTimeoutError
from rig.instruments.interfaces import members
from rig.instruments.roles import OffersReader
from rig.testing.case import STRANGER, TIMEOUT_S, Case, Service
from rig.testing.raising import raising
from rig.testing.roles import ROLES
from rig.testing.script import Role, at_rest, near, same, soon
from rig.testing.stage import READ_BACK

Check = Callable[[Case], None]
KINDS = ("silence", "garbage", "close", "truncate", "stale")
FURTHER_DEALS = range(1, len(KINDS))
UNDISTURBED_S = 10.0
"""Time-out of an instrument that no fault keeps from answering; a busy computer never meets it."""
PATIENT_S = 1.0
"""The time-out with which a place of the walk is tried again where an answer did not come that no
fault has taken: a computer that is busy with other things lets client or server stand for longer
than TIMEOUT_S now and then. A driver that goes wrong at a place does so with any time-out. A drive
that stops when no one speaks to it must wait for longer than this: its case's settings say so."""


def checks_of(case: Case) -> dict[str, Check]:
    """Return every check that applies to a case, by its name.

    The walk of faults deals each request of an experiment one kind of fault. `further_walks_of`
    deals it the others.
    """
    each: dict[str, Check] = {
        name.removeprefix("check_"): check
        for name, check in globals().items()
        if name.startswith("check_")
    }
    if not case.every_fault:
        del each[WALK]
    if case.no_identity:
        del each[STRANGERS]
    return each


def further_walks_of(case: Case, deals: Collection[int] = FURTHER_DEALS) -> dict[str, Check]:
    """Return walks of faults, one for each of `deals`: every request meets another kind in each,
    and all four together give it every kind that it is not dealt in the check itself."""
    if not case.every_fault:
        return {}
    return {f"{WALK}-deal-{deal}": partial(walk_dealt, deal=deal) for deal in deals}


def role_of(case: Case) -> Role:
    """Return the role that the case's driver module names first."""
    return ROLES[case.module().ROLES[0]]


def connect(case: Case, service: Service) -> Any:
    """Return the instrument, connected as its settings say, and attend to it as its role needs.

    Raises what the driver's `connect` raises. End it with `close`.
    """
    module = case.module()
    instrument = module.connect(module.Settings.model_validate(service.settings), service.clock)
    service.attending[id(instrument)] = role_of(case).attend(instrument, service)
    return instrument


def close(service: Service, instrument: Any) -> None:
    """Close an instrument as the runner does: no one attends to it any more."""
    if (leave := service.attending.pop(id(instrument), None)) is not None:
        leave()
    instrument.close()


@contextmanager
def undisturbed(case: Case) -> Iterator[Service]:
    """Run the case's simulator without faults; nothing depends on a short time-out then."""
    with case.serve() as service:
        service.settings["timeout_s"] = UNDISTURBED_S
        yield service


class Remembering:
    """An instrument that remembers which of its members were used."""

    def __init__(self, inner: Any):
        self._inner = inner
        self.used: set[str] = set()

    def __getattr__(self, name: str) -> Any:
        self.used.add(name)
        return getattr(self._inner, name)


# --- what a driver is ------------------------------------------------------------------------


def check_the_module_has_what_an_entry_point_names(case: Case) -> None:
    """The module names roles that exist, and its functions have the arguments of its group."""
    module = case.module()
    unknown = set(module.ROLES) - set(ROLES)
    assert not unknown, f"ROLES has {', '.join(unknown)}; known are {', '.join(ROLES)}"
    for function, wanted in (("connect", ["settings", "clock"]), ("make_safe", ["settings"])):
        named = list(inspect.signature(getattr(module, function)).parameters)
        same(f"the list of arguments of {function}()", named, wanted)


def check_settings_refuse_an_unknown_key_and_name_it(case: Case) -> None:
    """A misspelt key of the bench file is refused by its name."""
    with undisturbed(case) as service:
        settings = case.module().Settings
        settings.model_validate(service.settings)
        message = "an unknown key was not refused"
        try:
            settings.model_validate({**service.settings, "colour": "red"})
        except ValidationError as error:
            message = str(error)
        assert "colour" in message, f"the unknown key 'colour' is not named: {message}"


def check_the_instrument_has_every_member_of_its_role(case: Case) -> None:
    """The connected instrument has every member of its role."""
    with undisturbed(case) as service:
        instrument = connect(case, service)
        for name, member in members(role_of(case).protocol).items():
            assert hasattr(instrument, name), f"the instrument lacks {name}"
            own = getattr(instrument, name)
            if callable(member):
                wanted = list(inspect.signature(member).parameters)[1:]
                named = list(inspect.signature(own).parameters)
                same(f"the list of arguments of {name}()", named, wanted)
        close(service, instrument)


def check_a_whole_experiment_works_and_calls_every_method(case: Case) -> None:
    """The script of the role runs from its beginning to its end and calls each of its methods."""
    role = role_of(case)
    with undisturbed(case) as service:
        instrument = Remembering(connect(case, service))
        number = instrument.identity.serial_number
        assert instrument.identity.simulated is not bool(case.anonymous), (
            f"the identity has the serial number {number!r}; that of a simulated instrument begins "
            f"with SIM{', but ' + case.anonymous if case.anonymous else ''}"
        )
        limits = instrument.limits()
        same("the set of quantities of limits()", set(limits), set(role.quantities))
        for quantity, limit in limits.items():
            fixed = quantity == "rate"  # one that cannot be set has no width
            assert limit.low < limit.high or (fixed and limit.low == limit.high), (
                f"limits()[{quantity!r}] is {limit.low:g} to {limit.high:g}"
            )
            assert instrument.identity.model in limit.limited_by, (
                f"limits()[{quantity!r}] has limited_by {limit.limited_by!r}, which does not name "
                f"the model {instrument.identity.model!r}"
            )
        for step in role.script:
            step.act(instrument, service)
        close(service, instrument)
        unused = set(members(role.protocol)) - instrument.used
        assert not unused, f"the script of the role does not use {', '.join(sorted(unused))}"


def check_connecting_leaves_the_instrument_at_rest(case: Case) -> None:
    """Connecting brings to rest what an earlier connection has left switched on or moving."""
    with undisturbed(case) as service:
        first = connect(case, service)
        role_of(case).excite(first, service)
        assert not service.at_rest(), NOT_EXCITED
        if case.exclusive_link:
            with raising(InstrumentError, "connecting to a port in use") as caught:
                connect(case, service)
            _names_the_place(caught.error.one_line(), service)
            assert not service.at_rest(), "an attempt to connect has disturbed the first connection"
            close(service, first)
        second = connect(case, service)
        at_rest(service, "after connecting")
        close(service, first)
        close(service, second)


def check_what_can_only_be_tried_without_faults_works(case: Case) -> None:
    """The steps of the script that no fault may disturb work."""
    for step in role_of(case).apart:
        with undisturbed(case) as service:
            instrument = connect(case, service)
            step.act(instrument, service)
            close(service, instrument)


# --- what goes wrong -------------------------------------------------------------------------


def check_one_fault_anywhere_gives_an_error_or_the_right_value_and_is_over(case: Case) -> None:
    """Each request of a whole experiment meets one kind of fault in turn, always the same for the
    request; of those that `Case.alike` names only the first in a step does.

    Every step either does what it says or raises an InstrumentError that says what to do; a late,
    broken or foreign reply never becomes a value. What failed once works when it is repeated.
    """
    places = dealt_places(case)
    assert places, "the experiment has no request that could meet a fault"
    walk(case, list(places.items()))


NOT_EXCITED = "the simulator is at rest although the driver has set it going"
STRANGERS = "another_instrument_is_refused_with_both_names_and_released"
WALK = "one_fault_anywhere_gives_an_error_or_the_right_value_and_is_over"


def walk_dealt(case: Case, deal: int) -> None:
    """Walk all requests that are answered with the kinds of fault of a further deal."""
    walk(case, list(dealt_places(case, deal).items()))


def dealt_places(case: Case, deal: int = 0) -> dict[int, str]:
    """Return the requests that a walk visits, counted from 1, and the kind of fault of each.

    A request without an answer can only meet a broken connection, and does in the first deal.
    """
    by_kind = {kind: places_of_faults(case, kind) for kind in ("silence", "close")}
    places: dict[int, str] = {}
    for at in by_kind["close"]:
        # A checksum and not a random number: the same request meets the same kind in every run.
        if at in by_kind["silence"]:
            places[at] = KINDS[(zlib.crc32(f"{case}-{at}".encode()) + deal) % len(KINDS)]
        elif deal == 0:
            places[at] = "close"
    return places


def walk(case: Case, faults: list[tuple[int, str]]) -> None:
    """Run an experiment for each of the faults, which are a number of a request and a kind."""
    for at, kind in faults:
        failures, heard, unexplained = faulty_experiment(case, kind, at, TIMEOUT_S)
        if unexplained:
            failures, heard, unexplained = faulty_experiment(case, kind, at, PATIENT_S)
            assert not unexplained, f"{kind} at request {at} ({heard}): {unexplained}"
        where = f"{kind} at request {at} ({heard})"
        assert len(failures) <= 1, f"{where}: {[str(f) for f in failures]}"
        for failure in failures:
            for part in ("device", "command", "hint"):
                assert getattr(failure, part), f"{where}: an error without {part}: {failure}"
        if kind == "silence" and not (at == 1 and case.deaf_greeting):
            assert failures, f"{where}: the fault was not reported"
            # Frames that carry a number show by the next one that some are missing: no time-out.
            assert heard.startswith("STREAM") or isinstance(failures[0], InstrumentTimeoutError), (
                f"{where}: the error must be an InstrumentTimeoutError, and is "
                f"{type(failures[0]).__name__}: {failures[0].one_line()}"
            )


def faulty_experiment(
    case: Case, kind: str, at: int, timeout_s: float
) -> tuple[list[InstrumentError], str, str]:
    """Return three results of an experiment with one fault: the errors, the request to which the
    fault was applied, and the time-outs that one fault does not explain, because they come in
    addition to another error or from a step that was repeated."""
    with case.serve({"kind": kind, "at": at}) as service:
        service.settings["timeout_s"] = timeout_s
        failures: list[InstrumentError] = []
        unexplained = ""
        try:
            experiment_with_retries(case, service, failures, fault_at=at)
            assert service.faults.requests >= at, "an experiment says the same every time"
        except InstrumentError as again:
            # A time-out without a fault may have taken the one repetition that the fault needs.
            if not any(isinstance(one, InstrumentTimeoutError) for one in (*failures, again)):
                raise
            unexplained = again.one_line()
        if failures[1:] and any(isinstance(one, InstrumentTimeoutError) for one in failures):
            unexplained = "; ".join(one.one_line() for one in failures)
        heard = service.faults.heard[at - 1] if service.faults.requests >= at else b"nothing"
        return failures, heard[:40].decode("ascii", "replace"), unexplained


def places_of_faults(case: Case, kind: str) -> list[int]:
    """Return which requests of an experiment without faults the walk visits, counted from 1.

    A request that has no answer can lose none: only a broken connection disturbs it.
    """
    with undisturbed(case) as service:
        steps: list[int] = []
        failures: list[InstrumentError] = []
        experiment_with_retries(case, service, failures, steps)
        assert not failures, f"without a fault: {[one.one_line() for one in failures]}"
        heard, answered = service.faults.heard, service.faults.answered
    seen: set[tuple[int, bytes]] = set()
    places = []
    for index, request in enumerate(heard):
        if kind != "close" and not answered[index]:
            continue
        said = {(bisect_right(steps, index), one) for one in case.alike if request.startswith(one)}
        if not said or said - seen:
            places.append(index + 1)
        seen |= said
    return places


def experiment_with_retries(
    case: Case,
    service: Service,
    failures: list[InstrumentError],
    begins: list[int] | None = None,
    fault_at: int | None = None,
) -> None:
    """Run the role's script. A step that fails is repeated once, and its error goes to `failures`.

    `begins` receives the number of requests before each step. With `fault_at`, the number of the
    request that meets a fault, the script ends with the first step with requests after the one that
    met it: that step shows that the fault is over.
    """
    try:
        instrument = connect(case, service)
    except InstrumentError as failure:
        failures.append(failure)
        instrument = connect(case, service)
    try:
        for step in role_of(case).script:
            before = service.faults.requests
            if begins is not None:
                begins.append(before)
            try:
                step.act(instrument, service)
            except InstrumentError as failure:
                failures.append(failure)
                step.act(instrument, service)
            if fault_at is not None and fault_at <= before < service.faults.requests:
                break
    finally:
        close(service, instrument)  # also where a step has failed twice: its port may be shared


def check_silence_is_reported_with_device_command_time_and_remedy(case: Case) -> None:
    """A silent instrument is reported with its role, the command, the time-out and a remedy, and
    the time that was waited is charged to the clock once."""
    with case.serve({"kind": "silence", "count": 0}) as service:
        before = service.now_s()
        with raising(InstrumentTimeoutError, "connecting to a silent instrument") as caught:
            connect(case, service)
        error = caught.error
        same("the device of the error", error.device, case.module().ROLES[0])
        for words in (error.command, f"no answer within {TIMEOUT_S:g} s"):
            assert words in error.message, f"{words!r} is missing in {error.message!r}"
        _names_the_place(error.hint, service)
        charged_s = service.now_s() - before
        assert abs(charged_s - TIMEOUT_S) <= 1e-3, (
            f"a time-out of {TIMEOUT_S:g} s let {charged_s:g} s of bench time pass: the driver has "
            "to charge it to the clock, once"
        )


def check_an_instrument_that_is_not_there_is_reported(case: Case) -> None:
    """An instrument that is not there is reported with its role and its address."""
    with undisturbed(case) as service:
        pass  # its port is closed again
    with raising(InstrumentError, "connecting to an instrument that is not there") as caught:
        connect(case, service)
    same("the device of the error", caught.error.device, case.module().ROLES[0])
    _names_the_place(caught.error.hint, service)


def check_an_instrument_that_goes_away_and_comes_back_works_again(case: Case) -> None:
    """After a connection that was closed by the instrument a new one works."""
    step = role_of(case).script[-1]
    with case.serve({"kind": "close", "at": 1, "command": ""}) as service:
        service.settings["timeout_s"] = UNDISTURBED_S
        with raising(InstrumentError, "connecting to an instrument that hangs up"):
            connect(case, service)
        instrument = connect(case, service)
        step.act(instrument, service)
        close(service, instrument)


def check_another_instrument_is_refused_with_both_names_and_released(case: Case) -> None:
    """Another instrument at the address is refused with both names, and its link is closed."""
    with case.serve(identity=STRANGER) as service:
        service.settings["timeout_s"] = UNDISTURBED_S
        stranger = (
            f"connecting to another instrument: the simulator has vendor {STRANGER[0]!r} and model "
            f"{STRANGER[1]!r} now and answers with these members; connect() must refuse it"
        )
        with raising(InstrumentError, stranger) as caught:
            connect(case, service)
        line = caught.error.one_line()
        _names_the_place(line, service)
        for words in (case.stranger_says, "expected"):
            assert words in line, f"{words!r} is missing in {line!r}"
        _let_go(service)


# --- reading a stage without changing it -----------------------------------------------------


def check_a_reader_shows_what_the_stage_does_and_changes_nothing(case: Case) -> None:
    """Open the reader while the stage moves, without a run; a driver without one has
    nothing to show."""
    module = case.module()
    if not _offers_reader(case):
        return
    same(
        "the list of arguments of open_reader()",
        list(inspect.signature(module.open_reader).parameters),
        ["settings", "clock"],
    )
    what = "angle" if "angle" in role_of(case).quantities else "position"
    with undisturbed(case) as service:
        instrument = connect(case, service)
        role_of(case).excite(instrument, service)
        close(service, instrument)
        settings = module.Settings.model_validate(service.settings)
        speed = service.truth("speed")
        reader = module.open_reader(settings, service.clock)
        if reader.identity.serial_number != "unknown":  # some take a write to be asked for it
            same("identity.simulated of a reader", reader.identity.simulated, not case.anonymous)
        before, status = service.truth(what), reader.read()
        _lies_between(f"the {what} of a moving stage", status.position, before, service.truth(what))
        same("moving of a moving stage", status.moving, True)
        same("homed", status.homed, service.truth("homed"))
        same("the fault of a sound stage", status.fault, "")
        assert status.servo, "servo is empty: it says in a word what the motor's power does"
        near("the speed, read,", service.truth("speed"), speed, 0.01 * abs(speed), "per second")
        reader.close()
        reader.close()
        _let_go(service)
        near("the speed, let go,", service.truth("speed"), speed, 0.01 * abs(speed), "per second")
    with undisturbed(case) as service:
        settings = module.Settings.model_validate(service.settings)
        reader = module.open_reader(settings, service.clock)  # of a stage that no run has had
        before, status = service.truth(what), reader.read()
        same("moving of a stage at rest", status.moving, False)
        same("homed of a stage at rest", status.homed, service.truth("homed"))
        same(f"the {what} after reading", service.truth(what), before)
        at_rest(service, "after reading")
        reader.close()


def check_a_reader_refuses_what_is_silent_or_another_instrument(case: Case) -> None:
    """The module's reader refuses an instrument that is silent or a different one."""
    if not _offers_reader(case):
        return
    module = case.module()
    with case.serve({"kind": "silence", "count": 0}) as service:
        settings = module.Settings.model_validate(service.settings)
        with raising(InstrumentTimeoutError, "open_reader() of a silent instrument") as silent:
            module.open_reader(settings, service.clock)
        _names_the_place(silent.error.hint, service)
        _let_go(service)
    with case.serve(identity=STRANGER) as service:
        service.settings["timeout_s"] = UNDISTURBED_S
        settings = module.Settings.model_validate(service.settings)
        with raising(InstrumentError, "open_reader() of another instrument") as stranger:
            module.open_reader(settings, service.clock)
        assert case.stranger_says in stranger.error.one_line(), stranger.error.one_line()
        _let_go(service)


def _offers_reader(case: Case) -> bool:
    """Return whether the driver is a stage's and offers a reader."""
    return isinstance(case.module(), OffersReader) and "speed" in role_of(case).quantities


def _lies_between(what: str, value: float, one: float, other: float) -> None:
    low, high = min(one, other) - READ_BACK, max(one, other) + READ_BACK
    assert low <= value <= high, f"{what} is {value:g}; it must be {low:g} to {high:g}"


# --- making safe and letting go --------------------------------------------------------------


def check_make_safe_of_the_module_works_during_a_live_connection(case: Case) -> None:
    """`make_safe` of the module works while another connection to the instrument is open."""
    module = case.module()
    dies = bool(case.exclusive_link and not case.drives_nothing)
    """Close the live connection first where the instrument accepts only one."""
    with undisturbed(case) as service:
        settings = module.Settings.model_validate(service.settings)
        instrument = connect(case, service)
        role_of(case).excite(instrument, service)
        assert not service.at_rest(), NOT_EXCITED
        if dies:
            close(service, instrument)
        for _ in range(2):
            said = service.faults.requests
            with service.in_real_time():
                module.make_safe(settings)
            if case.drives_nothing:
                assert not service.at_rest(), f"make_safe() stops it, but {case.drives_nothing}"
                same("the number of requests", service.faults.requests, said)
            else:
                at_rest(service, "after make_safe() of the module")
        if dies:
            instrument = connect(case, service)
        for step in role_of(case).script:  # the live connection is none the worse
            step.act(instrument, service)
        close(service, instrument)


def check_make_safe_of_a_silent_instrument_is_an_error(case: Case) -> None:
    """`make_safe` raises an InstrumentError where the instrument does not answer."""
    module = case.module()
    with case.serve({"kind": "silence", "count": 0}) as service:
        settings = module.Settings.model_validate(service.settings)
        if case.drives_nothing:
            module.make_safe(settings)
            same("the number of requests of make_safe()", service.faults.requests, 0)
            return
        with raising(InstrumentTimeoutError, "make_safe() of a silent instrument"):
            module.make_safe(settings)


def check_close_can_be_called_repeatedly(case: Case) -> None:
    """`close` may be called again, and the address is free after it."""
    with undisturbed(case) as service:
        instrument = connect(case, service)
        assert service.connections() > 0, "no connection is open after connect()"
        close(service, instrument)
        close(service, instrument)
        _let_go(service)


def _names_the_place(said: object, service: Service) -> None:
    assert service.place in str(said), f"{said!r} does not name {service.place}"


def _let_go(service: Service) -> None:
    """Fail unless every connection is closed, now or shortly."""
    assert soon(lambda: not service.connections()), (
        f"{service.connections()} connections are still open"
    )
