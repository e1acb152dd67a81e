"""What the simulated bench serves is for this computer alone."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from tiers import mostly_thorough

LISTENING = "0A"
"""State of a socket in /proc/net/tcp."""
LOOPBACK = "0100007F"
"""127.0.0.1 there, on a little-endian machine."""


def listening_addresses(pid: int) -> list[str]:
    """Addresses, in hexadecimal, on which a process listens."""
    own = set()
    for descriptor in Path(f"/proc/{pid}/fd").iterdir():
        name = str(descriptor.readlink())
        if name.startswith("socket:["):
            own.add(name.removeprefix("socket:[").removesuffix("]"))
    addresses = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            words = line.split()
            if words[3] == LISTENING and words[9] in own:
                addresses.append(words[1].partition(":")[0])
    return addresses


@pytest.mark.parametrize("link", mostly_thorough(["socket", "hislip"], ["socket"]))
def test_every_server_listens_on_127_0_0_1_only(rig, link):
    world = rig.world(f'generator_link = "{link}"\n')
    running = rig.start("simulate", "--write", "bench.toml", "--world", world)
    running.wait_for("in real time")

    addresses = listening_addresses(running.process.pid)
    least = 3 + rig.bench.z.on_tcp
    assert len(addresses) >= least, "generator, DAQ, the control socket, and the stage perhaps"
    assert set(addresses) == {LOOPBACK}
    running.send(signal.SIGINT)
    assert running.finish().code == 0
