"""A broken installed package disables what it registers, says so, and disables nothing else."""

from __future__ import annotations

import json
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from benches import declare_soft_contact
from packages import install, on_path
from tiers import mostly_nightly, mostly_thorough

REGISTERED = "[rig.procedures]\ncreep = lab.creep:Creep\n"
COMPLETE = '''"""The creep of the skin."""
from procedures.sweep import Sweep

class Creep(Sweep):
    """Hold a force and watch the skin creep."""
    name = "creep"
'''
WITHOUT_TAKE = '''
from rig.core.settings import Settings
from rig.run.procedure import Procedure

class Creep(Procedure):
    """Hold a force and watch the skin creep."""
    name, fixtures, Settings = "creep", ("plate",), Settings
    def points(self): return ()
    def arm(self, run): pass
'''
BROKEN: dict[str, tuple[str, dict[str, str], str]] = {
    "syntax error": (
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": '"""Creep."""\n\ndef take(:\n'},
        r"lab/creep\.py line 3: SyntaxError: ",
    ),
    "syntax error in the package around it": (
        REGISTERED,
        {"lab/__init__.py": "x = = 1\n", "lab/creep.py": COMPLETE},
        r"lab/__init__\.py line 1: SyntaxError: ",
    ),
    "import error": (
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": f"{COMPLETE}import acme_sdk\n"},
        r"lab/creep\.py line 7: ModuleNotFoundError: No module named 'acme_sdk'.*; "
        r"install acme_sdk, which the package lab-creep needs",
    ),
    "raises when imported": (
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": COMPLETE + "1 / 0\n"},
        r"lab/creep\.py line 7: ZeroDivisionError: ",
    ),
    "ends the program when imported": (
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": "raise SystemExit(0)\n"},
        r"lab/creep\.py line 1: SystemExit: ",
    ),
    "missing module": (
        REGISTERED,
        {"lab/__init__.py": ""},
        r"ModuleNotFoundError: No module named 'lab\.creep'; fix the package",
    ),
    "missing folder": (REGISTERED, {}, r"ModuleNotFoundError: No module named 'lab'; fix"),
    "no module's name": ("[rig.procedures]\ncreep = lab creep\n", {}, "does not name a module"),
    "missing members": (
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": WITHOUT_TAKE},
        "lacks layout, take; ",
    ),
    "a module in place of a class": (
        "[rig.procedures]\ncreep = lab.creep\n",
        {"lab/__init__.py": "", "lab/creep.py": COMPLETE},
        "names a module; it must name the procedure's class, a subclass of "
        r"rig\.run\.procedure\.Procedure: creep = lab\.creep:ClassName",
    ),
    "a class that is not there": (
        "[rig.procedures]\ncreep = lab.creep:Crep\n",
        {"lab/__init__.py": "", "lab/creep.py": COMPLETE},
        r"cannot be imported: .*has no attribute 'Crep'",
    ),
    "another name": (
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": COMPLETE + '    name = "slow-creep"\n'},
        "has the name 'slow-creep', which must be that of the entry point",
    ),
}
"""Entry points, modules, and what `rig creep` says of them."""
SEEN_IN_SOURCE = (
    *("syntax error", "syntax error in the package around it"),
    *("missing module", "missing folder", "no module's name"),
)
"""What is found without importing anything."""


BROKEN_BY_DEFAULT = ("syntax error", "import error", "missing members")


@pytest.fixture(params=mostly_thorough(BROKEN, BROKEN_BY_DEFAULT))
def broken(request: pytest.FixtureRequest, rig: Any, tmp_path: Path) -> str:
    """A package whose procedure `creep` is broken, on the command line's path; in which way."""
    entry_points, modules, _ = BROKEN[request.param]
    on_path(rig, install(tmp_path / "site", "lab-creep", entry_points, modules))
    return str(request.param)


def test_help_lists_every_other_procedure_and_what_is_unavailable(rig: Any, broken: str) -> None:
    shown = rig.run("--help")
    assert shown.code == 0, shown.stderr
    assert shown.stderr == ""
    text = " ".join(shown.stdout.split())
    assert " sweep " in text
    assert " make-safe Put every instrument" in text
    if broken in SEEN_IN_SOURCE:
        assert "creep (unavailable: lab-creep: " in text
    else:
        assert " creep " in text


def test_the_procedure_itself_is_refused_in_one_line(rig: Any, broken: str) -> None:
    refused = rig.run("creep", "--dry-run", "--json")
    assert refused.code == 2, refused.stderr
    (error,) = refused.errors
    assert refused.stderr.splitlines() == [error]
    assert "procedure 'creep' of the package lab-creep (entry point creep = lab" in error
    assert re.search(BROKEN[broken][2], error), error
    assert "uninstall it" in error
    assert refused.object["errors"] == [error.removeprefix("error: ")]
    assert not rig.results.exists()


@pytest.mark.thorough
def test_a_complete_procedure_of_another_package_is_listed_and_runs(
    rig: Any, tmp_path: Path
) -> None:
    """What the broken ones are variations of."""
    modules = {"lab/__init__.py": "raise SystemExit('imported')", "lab/creep.py": COMPLETE}
    site = install(tmp_path / "site", "lab-creep", REGISTERED, modules)
    on_path(rig, site)
    shown = rig.run("--help")
    assert shown.code == 0, "nothing is imported for it"
    assert "Hold a force and watch the skin creep" in " ".join(shown.stdout.split())
    (site / "lab" / "__init__.py").write_text("print('imported')")
    done = rig.run("creep", "--frequencies", "200", "--no-figures", "--json")
    assert done.code == 0, done.stderr
    assert json.loads(done.stdout)["points_done"] == 1, "what it prints is not for stdout"
    assert "imported" in done.stderr


def everything_broken(site: Path) -> Path:
    """A package for every way to be broken in every group, and one that registers names which are
    taken."""
    for number, (entry_points, modules, _) in enumerate(BROKEN.values()):
        own = f"lab{number}"
        install(
            site,
            f"lab-{number}",
            entry_points.replace("creep", f"creep-{number}", 1).replace("lab", own)
            + f"[rig.drivers]\nacme-{number} = {own}.creep\n"
            + f"[rig.benches]\nbench-{number} = {own}.creep\n",
            {name.replace("lab", own, 1): source for name, source in modules.items()},
        )
    install(
        site,
        "lab-usurper",
        "[rig.procedures]\nmake-safe = usurper\nsweep = usurper\nskin = usurper\n"
        "[rig.drivers]\nkeysight-33500b = usurper\n[rig.benches]\nsimulated = usurper\n",
        {"usurper.py": "def broken(:\n"},
    )
    return site


@pytest.mark.thorough
def test_every_other_command_works_beside_all_of_them(rig: Any, tmp_path: Path) -> None:
    done = rig.run("sweep", "--frequencies", "200", "--no-figures")
    assert done.code == 0, done.stderr
    file = str(rig.only("*.h5"))
    on_path(rig, everything_broken(tmp_path / "site"))

    shown = rig.run("--help")
    assert shown.code == 0, shown.stderr
    assert shown.stderr.splitlines() == [
        f"warning: the procedure {name!r} of the package lab-usurper is left out: rig has a "
        f"command {name!r} already; rename it there"
        for name in ("make-safe", "skin", "sweep")
    ]
    for command in (
        ("show", "--no-figures", file),
        ("verify", file),
        ("sweep", "--dry-run", "--frequencies", "200"),
        ("skin", "--help"),
    ):
        ended = rig.run(*command)
        assert ended.code == 0, ended.stderr
        assert "lab" not in ended.stderr, "and says nothing of what it does not need"
    schema = rig.run("batch", "schema")
    assert schema.code == 0, schema.stderr
    defaults = json.loads(schema.stdout)["properties"]["defaults"]["properties"]
    assert set(defaults) >= {"sweep", "slip-trial", "roll-trial"}
    assert not any(name.startswith("creep") for name in defaults)
    assert "warning: procedure 'creep-0' of the package lab-0 " in schema.stderr


@pytest.mark.thorough
def test_a_file_of_a_procedure_that_is_broken_now_is_shown_without_its_summary(
    rig: Any, tmp_path: Path
) -> None:
    site = install(
        tmp_path / "site",
        "lab-creep",
        REGISTERED,
        {"lab/__init__.py": "", "lab/creep.py": COMPLETE},
    )
    on_path(rig, site)
    done = rig.run("creep", "--frequencies", "200", "--no-figures")
    assert done.code == 0, done.stderr
    file = str(rig.only("*.h5"))
    for hook, words in {
        "summarise(self, readings): return {'c': object()}": "creep of package lab-creep: summaris",
        "__init__(self, settings): raise OSError('no licence')": "internal error: OSError: no lic",
    }.items():
        (site / "lab" / "creep.py").write_text(f"{COMPLETE}    def {hook}\n")
        shown = rig.run("show", "--no-figures", "--all", file)
        assert shown.code == 0, shown.stderr
        (line,) = shown.stderr.splitlines()
        assert line.startswith("warning: no summary: ")
        assert words in line
        assert "columns:" in shown.stdout, "all else of the file is shown"
    (site / "lab" / "creep.py").write_text("def broken(:\n")
    shown = rig.run("show", "--no-figures", file)
    assert shown.code == 0, shown.stderr
    assert "creep" in shown.stdout
    (line,) = shown.stderr.splitlines()
    assert line.startswith("warning: no summary: procedure 'creep' of the package lab-creep ")
    assert rig.run("verify", file).code == 0


DRIVER = """
from typing import Literal
from drivers.keysight_u2300a import driver as keysight_u2300a
from drivers.keysight_u2300a.driver import ROLES, connect, make_safe
class Settings(keysight_u2300a.Settings):
    driver: Literal["acme-daq"]
"""
DRIVERS = {
    "sound": DRIVER,
    "syntax error": "def connect(:\n",
    "no connect": DRIVER + "del connect\n",
    "no make_safe": DRIVER + "del make_safe\n",
    "no Settings": DRIVER + "del Settings\n",
    "ends the program": "raise SystemExit(0)\n",
}
SAID = {
    "syntax error": "acme_daq.py line 1: SyntaxError: ",
    "no connect": "lacks connect; ",
    "no make_safe": "lacks make_safe; ",
    "no Settings": "lacks Settings; ",
    "ends the program": "acme_daq.py line 1: SystemExit: 0",
}
NAMED = (
    "driver 'acme-daq' of the package lab-daq (entry point acme-daq = acme_daq of the group "
    "rig.drivers) "
)


@pytest.fixture
def acme(rig: Any, tmp_path: Path) -> Iterator[Path]:
    """A simulated bench in real time whose DAQ another package drives; the driver's source. Its
    generator is on."""
    site = install(
        tmp_path / "site",
        "lab-daq",
        "[rig.drivers]\nacme-daq = acme_daq\n",
        {"acme_daq.py": DRIVERS["sound"]},
    )
    on_path(rig, site)
    serving = rig.start("simulate", "--write", "sim.toml", "--world-log", str(rig.world_log))
    serving.wait_for("Ctrl-C ends it")
    text = (rig.folder / "sim.toml").read_text()
    assert text.count('"keysight-u2300a"') == 1
    (rig.folder / "sim.toml").write_text(text.replace('"keysight-u2300a"', '"acme-daq"'))
    declare_soft_contact(rig.folder / "sim.toml")
    yield site / "acme_daq.py"
    serving.send(signal.SIGINT)
    assert serving.finish().code == 0


def switch_on(rig: Any) -> None:
    """Switch the generator's output on, as a run that nobody guards would leave it."""
    from rig.bench.plan import parse_to_make_safe
    from rig.core.clock import WallClock

    text = (rig.folder / "sim.toml").read_text()
    (part,) = (p for p in parse_to_make_safe(text, "").instruments if p.role == "generator")
    generator: Any = part.driver.connect(part.settings, WallClock())
    generator.output(True)
    generator.close()
    assert rig.outputs() == [True]


@pytest.mark.parametrize("way", mostly_thorough(SAID, ["syntax error"]))
def test_a_broken_driver_keeps_no_other_instrument_from_being_made_safe(
    rig: Any, acme: Path, way: str
) -> None:
    switch_on(rig)
    acme.write_text(DRIVERS[way])

    refused = rig.run("sweep", "--bench", "sim.toml", "--frequencies", "200")
    assert refused.code == 2, refused.stderr
    (error,) = refused.errors
    assert "[daq]: " + NAMED in error
    assert SAID[way].rstrip("; ") in error
    assert "fix the package lab-daq or uninstall it" in error
    assert rig.outputs() == [True], "and nothing was touched"

    made = rig.run("make-safe", "--bench", "sim.toml")
    assert made.code == 7, made.stderr
    assert "simulated: generator, stage_z, force_sensor made safe" in made.stderr.splitlines()
    error, last = made.errors
    assert last.startswith("error: NOT SAFE: daq. Switch the bench off by hand")
    assert error.startswith("error: daq: ")
    assert NAMED in error
    assert SAID[way].rstrip("; ") in error
    assert rig.outputs() == [True, False]


def test_a_driver_that_is_not_installed_or_set_wrongly_keeps_no_other_from_it(
    rig: Any, acme: Path
) -> None:
    switch_on(rig)
    file = rig.folder / "sim.toml"
    text = file.read_text()
    file.write_text(text.replace('"acme-daq"', '"acme-dac"') + "\n[oven]\nheat_C = 20\n")
    made = rig.run("make-safe", "--bench", "sim.toml")
    assert made.code == 7, made.stderr
    daq, file_error, _ = made.errors
    assert "daq: sim.toml: [daq]: driver 'acme-dac' is unknown" in daq
    assert "bench file: sim.toml: oven: unknown key" in file_error
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_settings_of_a_driver_that_raise_keep_no_other_instrument_from_it(
    rig: Any, acme: Path
) -> None:
    switch_on(rig)
    validator = "    def model_post_init(self, _): raise RuntimeError('no licence')\n"
    acme.write_text(DRIVERS["sound"] + validator)
    made = rig.run("make-safe", "--bench", "sim.toml")
    assert made.code == 7, made.stderr
    error, last = made.errors
    assert "daq: RuntimeError: no licence" in error
    assert "NOT SAFE: daq." in last
    assert rig.outputs() == [True, False]


@pytest.mark.thorough
def test_the_guard_makes_safe_what_it_can_and_names_the_broken_driver(rig: Any, acme: Path) -> None:
    """A driver that broke while its run was under way, which then died."""
    frequencies = ",".join(str(f) for f in range(300, 2300, 100))
    running = rig.start(
        "sweep", "--bench", "sim.toml", "--no-figures", "--frequencies", frequencies
    )
    running.wait_for("^1/20 ")
    acme.write_text(DRIVERS["syntax error"])
    running.send(signal.SIGKILL)
    running.process.wait()
    rig.await_world("ch1.on", False)

    path = rig.results / "guard-simulated.json"
    deadline = time.monotonic() + 30
    while not (path.exists() and "file" in (report := json.loads(path.read_text()))):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert report["safe"] is False
    assert list(report["failures"]) == ["daq"]
    assert NAMED in report["failures"]["daq"]
    assert rig.outputs() == [True, False]

    acme.write_text(DRIVERS["sound"])
    refused = rig.run("sweep", "--bench", "sim.toml", "--frequencies", "200")
    assert refused.code == 7
    assert "lab-daq" in refused.errors[0]
    assert rig.run("make-safe", "--bench", "sim.toml").code == 0


FAULTY = (
    COMPLETE
    + """
    def take(self, run, point):
        reading = super().take(run, point)
        if point.condition.frequency_Hz > 250:
            {fault}
        return reading
"""
)
FAULTS = {
    "reading['creep_um'] = 1 / 0": (
        "a fault in the package lab-creep: lab/creep.py line 11: ZeroDivisionError: division by "
        "zero; the traceback is in rig.log"
    ),
    "del reading['gain_dB']": (
        "procedure creep of package lab-creep: take() returned no 'gain_dB', which its layout "
        "declares"
    ),
}


@pytest.mark.parametrize("fault", mostly_nightly(FAULTS, [next(iter(FAULTS))]))
def test_a_fault_in_a_run_is_reported_as_the_packages_and_the_data_are_saved(
    rig: Any, tmp_path: Path, fault: str
) -> None:
    modules = {"lab/__init__.py": "", "lab/creep.py": FAULTY.format(fault=fault)}
    on_path(rig, install(tmp_path / "site", "lab-creep", REGISTERED, modules))
    log = ("--world-log", str(rig.world_log))
    ended = rig.run("creep", "--frequencies", "200,300", "--json", *log)
    assert ended.code == 1, ended.stderr
    (error,) = ended.errors
    assert error.startswith(f"error: {FAULTS[fault]}")
    assert rig.outputs() == [True, False]
    assert ended.object["points_done"] == 1
    assert "Bench is safe: generator off, " in ended.stderr
    assert rig.run("verify", ended.object["file"]).code == 0
    assert "Traceback" in (rig.results / "rig.log").read_text() or "del" in fault


def test_a_procedure_whose_settings_share_an_option_is_refused(rig: Any, tmp_path: Path) -> None:
    source = COMPLETE.replace(
        "class Creep",
        "class Own(Sweep.Settings):\n    load_mm: float = 1.0\n\nclass Creep",
    )
    modules = {"lab/__init__.py": "", "lab/creep.py": source + "    Settings = Own\n"}
    on_path(rig, install(tmp_path / "site", "lab-creep", REGISTERED, modules))
    refused = rig.run("creep", "--load", "1N")
    assert refused.code == 2
    (error,) = refused.errors
    assert "of the package lab-creep" in error
    assert "'load_N' and 'load_mm', which would both be the option --load" in error


UNREADABLE = {
    "a line without =": b"[rig.procedures]\ncreep\n",
    "no text": b"\xff\xfe[rig.drivers]\n",
}


@pytest.fixture(params=UNREADABLE)
def unreadable(request: Any, rig: Any, tmp_path: Path) -> None:
    """A package on the command line's path whose list of entry points cannot be read."""
    site = install(tmp_path / "site", "lab-creep", "")
    (site / "lab_creep-1.0.dist-info" / "entry_points.txt").write_bytes(UNREADABLE[request.param])
    on_path(rig, site)


@pytest.mark.usefixtures("unreadable")
def test_entry_points_that_cannot_be_read_disable_their_own_package_only(rig: Any) -> None:
    helped = rig.run("--help")
    assert helped.code == 0, helped.stderr
    assert "slip-trial" in helped.stdout
    assert "the package in lab_creep-1.0.dist-info is not used" in helped.stderr
    made_safe = rig.run("make-safe")
    assert made_safe.code == 2
    assert "no bench.toml here" in made_safe.stderr


@pytest.mark.thorough
@pytest.mark.parametrize("unreadable", ["no text"], indirect=True)
@pytest.mark.usefixtures("unreadable")
def test_a_run_works_beside_entry_points_that_cannot_be_read(rig: Any) -> None:
    done = rig.run("sweep", "--frequencies", "200", "--no-figures")
    assert done.code == 0, done.stderr
