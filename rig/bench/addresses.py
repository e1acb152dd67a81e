"""The addresses of an instrument: as its bench file writes it, and in the forms that all names of
one instrument share.

``localhost`` is 127.0.0.1, a symbolic link is the serial port that it leads to, and
``/dev/serial/by-id`` has a second name for a USB port. Locks, marks and latches are kept under
every address, so that two bench files that name one instrument differently have at least one in
common. The name as it is written is always among them: it is what is left while a name server does
not answer or a port is unplugged.
"""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

ADDRESS = ("resource", "host", "port", "unit_id")
"""Settings of a driver that form the address of an instrument."""
BY_ID = Path("/dev/serial/by-id")
"""Links to USB ports, named after what is plugged in; they stay when the ports' numbers change."""
LOOPBACK = "127.0.0.1"


def addresses_of(settings: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the addresses of an instrument's link, from its driver's settings: first as it is
    written, then the others, each once.

    A serial line has one user, whichever instrument on it is addressed.
    """
    line = settings.get("port")
    if isinstance(line, str):
        return _each_once((line, *_of_port(line)))
    written = " ".join(str(settings[name]) for name in ADDRESS if name in settings)
    if isinstance(resource := settings.get("resource"), str):
        return _each_once((written, *_of_resource(resource)))
    if isinstance(host := settings.get("host"), str):
        rest = [str(settings[name]) for name in ADDRESS[2:] if name in settings]
        return _each_once((written, *(" ".join((ip, *rest)) for ip in _ips(host))))
    return _each_once((written,))


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
