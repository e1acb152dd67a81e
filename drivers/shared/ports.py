"""Serial ports and TCP ports, with the same few members, for the links of drivers.

``socket://host:port`` does not use pyserial, whose sockets take 0.3 s to close and 5 s to find that
nothing listens.
"""

from __future__ import annotations

import socket
from typing import Protocol
from urllib.parse import urlsplit

READ_WAIT_S = 0.005
"""Longest wait for bytes in one read: by so much a time-out may be late."""
SOCKET = "socket://"
READ_BYTES = 4096
USUAL_FORMAT = "8N1"
"""Eight data bits, no parity, one stop bit."""


class Port(Protocol):
    """Serial port or TCP connection that the bytes go through."""

    def write(self, data: bytes) -> None:
        """Send the bytes. Raises OSError where that fails."""
        ...

    def read(self) -> bytes:
        """Return the bytes that have come; wait for `READ_WAIT_S` if there are none."""
        ...

    def close(self) -> None:
        """Close the port."""
        ...


class SerialPort:
    """A serial port, opened exclusively; what waits in it is dropped."""

    def __init__(self, path: str, baudrate: int, timeout_s: float, serial_format: str):
        import serial

        self._port = serial.Serial(
            path,
            baudrate,
            bytesize=int(serial_format[0]),
            parity=serial_format[1],
            stopbits=int(serial_format[2]),
            timeout=READ_WAIT_S,
            write_timeout=timeout_s,
            exclusive=True,
        )
        self._port.reset_input_buffer()

    def write(self, data: bytes) -> None:
        """See `Port`."""
        self._port.write(data)

    def read(self) -> bytes:
        """See `Port`."""
        return bytes(self._port.read(self._port.in_waiting or 1))

    def close(self) -> None:
        """See `Port`."""
        self._port.close()


class TcpPort:
    """A TCP port, such as a terminal server's."""

    def __init__(self, url: str, timeout_s: float):
        where = urlsplit(url)
        self._socket = socket.create_connection((where.hostname or "", where.port or 0), timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._timeout_s = timeout_s

    def write(self, data: bytes) -> None:
        """See `Port`."""
        self._socket.settimeout(self._timeout_s)
        self._socket.sendall(data)
        self._socket.settimeout(READ_WAIT_S)

    def read(self) -> bytes:
        """See `Port`. Raises ConnectionResetError if the other end has closed the connection."""
        try:
            data = self._socket.recv(READ_BYTES)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("it was closed at the other end")
        return data

    def close(self) -> None:
        """See `Port`."""
        self._socket.close()


def open_port(
    place: str, baudrate: int, timeout_s: float, serial_format: str = USUAL_FORMAT
) -> Port:
    """Open ``socket://host:port``, or the serial port at a path, exclusively.

    `serial_format` has the data bits, the parity (N, E or O) and the stop bits. Raises OSError or
    ValueError where that fails (pyserial's exception is an OSError).
    """
    if place.startswith(SOCKET):
        return TcpPort(place, timeout_s)
    return SerialPort(place, baudrate, timeout_s, serial_format)
