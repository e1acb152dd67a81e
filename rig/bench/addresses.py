"""The addresses of an instrument: as its bench file writes it, and in the forms that all names of
one instrument share.

``localhost`` is 127.0.0.1, a symbolic link is the serial port that it leads to, and
``/dev/serial/by-id`` has a second name for a USB port. Locks, marks and latches are kept under
every address, so that two bench files that name one instrument differently have at least one in
common. The name as it is written is always among them: it is what is left while a name server does
not answer or a port is unplugged.

A driver marks the settings that form the address (`rig.core.settings.Address`). What kind of
address it is, its text says.
"""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from rig.core.settings import Settings, address_settings_of

UNMARKED = ("resource", "host", "port", "unit_id")
"""Settings that form the address where a driver marks none: those of drivers that were written
before there was a mark."""
RESOURCE = re.compile(r"ASRL|(\w+-)?(FIREWIRE|GPIB|PXI|TCPIP|USB|VICP|VXI)\d*::", re.IGNORECASE)
"""Beginning of a VISA resource. ``fe80::1`` is not one."""
SERIAL_PORT = re.compile(r".*/|COM\d+$", re.IGNORECASE)
"""Beginning of a serial port: a path, a URL such as ``socket://HOST:PORT``, or COM5."""
BY_ID = Path("/dev/serial/by-id")
"""Links to USB ports, named after what is plugged in; they stay when the ports' numbers change."""
LOOPBACK = "127.0.0.1"


def addresses_of(settings: Settings) -> tuple[str, ...]:
    """Return the addresses of an instrument's link, from its driver's settings: first as it is
    written, then the others, each once; none if the settings name no address.

    The first text among them says by its form what it is: a VISA resource, a serial port, or, with
    a number or another text beside it, a host. A serial line has one user, whichever instrument on
    it is addressed.
    """
    values = address_values(settings)
    written = " ".join(map(str, values.values()))
    name, text = next(((k, v) for k, v in values.items() if isinstance(v, str)), ("", ""))
    if RESOURCE.match(text):
        return _each_once((written, *_of_resource(text)))
    if SERIAL_PORT.match(text):
        return _each_once((text, *_of_port(text)))
    if text and (name == "host" or len(values) > 1):
        rest = [str(value) for key, value in values.items() if key != name]
        return _each_once((written, *(" ".join((ip, *rest)) for ip in _ips(text))))
    return _each_once((written,)) if written else ()


def address_values(settings: Settings) -> dict[str, Any]:
    """Return the settings that form the address of an instrument, by name; those that are left out
    (None) are not among them."""
    model = type(settings)
    names = address_settings_of(model) or [name for name in UNMARKED if name in model.model_fields]
    values = {name: getattr(settings, name) for name in names}
    return {name: value for name, value in values.items() if value is not None}


def _each_once(addresses: Iterable[str]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(address.upper() for address in addresses))


def _of_port(port: str) -> tuple[str, ...]:
    """Return the other names of a serial port, or of a port on the network."""
    if port.lower().startswith("socket://"):
        where = urlsplit(port)
        return tuple(f"socket://{ip}:{where.port}" for ip in _ips(where.hostname or ""))
    target = Path(port).resolve()
    links: list[str] = []
    with contextlib.suppress(OSError):
        links = sorted(str(link) for link in BY_ID.iterdir() if link.resolve() == target)
    return (str(target), *links)


def _of_resource(resource: str) -> tuple[str, ...]:
    """Return the other names of a VISA resource. What it leaves out is put in: the board's number,
    the LAN device, the class."""
    kind, *rest = resource.split("::")
    if kind.upper().startswith("ASRL"):
        return _of_port(kind[len("ASRL") :])
    kind = kind if kind[-1:].isdigit() else kind + "0"
    if rest and rest[-1].upper() not in ("INSTR", "SOCKET", "RAW"):
        rest.append("INSTR")
    if kind.upper().startswith("USB"):
        rest = [_decimal(field) for field in rest]
        if len(rest) == 5:  # its interface, of which 0 need not be given
            rest = [field for field in rest if field != "0"]
        return ("::".join((kind, *rest)),)
    if kind.upper().startswith("TCPIP") and rest:
        host, *rest = rest
        if len(rest) == 1 and rest[0].upper() == "INSTR":
            rest.insert(0, "inst0")
        return tuple("::".join((kind, ip, *rest)) for ip in _ips(host))
    return ("::".join((kind, *rest)),)


def _decimal(field: str) -> str:
    """Return the decimal form of a number such as 0x2A8D; anything else as it is."""
    try:
        return str(int(field, 0))
    except ValueError:
        return field


def _ips(host: str) -> tuple[str, ...]:
    """Return the addresses of a host, in order; none where no name server knows it."""
    try:
        found = {entry[4][0] for entry in socket.getaddrinfo(host, None)}
    except (OSError, UnicodeError):
        return ()
    return tuple(sorted({_ip(str(text)) for text in found}))


def _ip(text: str) -> str:
    """Return an IP address in one form; every one of this computer's loopback is the same."""
    address = ipaddress.ip_address(text.partition("%")[0])
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        address = address.ipv4_mapped
    return LOOPBACK if address.is_loopback else str(address)
