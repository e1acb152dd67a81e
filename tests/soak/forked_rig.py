"""The program ``rig`` many times over, each time in a process of its own that has imported already.

A job is a line of JSON on stdin: a folder and arguments. What is forked for it is the real command
line in that folder, its output in the files ``stdout`` and ``stderr``; its process id is told when
it begins and its exit code when it has ended. Importing is a third of what a short run costs.
"""

import importlib
import json
import os
import sys

from rig.cli import main

for name in (
    *("h5py", "numpy", "pymodbus.client", "pyvisa_py.highlevel", "serial", "scipy.optimize"),
    *("rig.cli.procedures", "rig.cli.report", "rig.files.runfile.compile", "rig.run.execute"),
    *("procedures.sweep", "procedures.slip_trial", "procedures.roll_trial"),
    *(
        "drivers.festo_cmmt.driver",
        "drivers.keysight_33500b.driver",
        "drivers.keysight_u2300a.driver",
    ),
    *(
        "drivers.me_gsv8.driver",
        "drivers.simulated.bench.start",
        "drivers.simulated.faults.disk",
        "drivers.zaber_rst.driver",
    ),
):
    importlib.import_module(name)

for line in sys.stdin:
    job = json.loads(line)
    child = os.fork()
    if child == 0:
        os.chdir(job["folder"])
        for descriptor, file in ((0, os.devnull), (1, "stdout"), (2, "stderr")):
            flags = os.O_RDONLY if descriptor == 0 else os.O_WRONLY | os.O_CREAT
            os.dup2(os.open(file, flags, 0o644), descriptor)
        sys.argv = ["rig", *job["arguments"]]
        main()  # which ends the process
    print(child, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
