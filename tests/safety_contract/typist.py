"""A command at a pseudo-terminal, and somebody who types there."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import subprocess
import termios
import threading
import time

REPEAT_S = 0.033
PATIENCE_S = 30.0


class Typist:
    """A command at a pseudo-terminal, and somebody who types there."""

    def __init__(self, rig, *arguments):
        self._master, self.slave = pty.openpty()
        self.before = termios.tcgetattr(self.slave)
        self.process = subprocess.Popen(
            rig.command(*arguments),
            cwd=rig.folder,
            env=rig.env,
            stdin=self.slave,
            stdout=self.slave,
            stderr=self.slave,
            start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )
        self._shown = ""
        threading.Thread(target=self._read, daemon=True).start()

    def sees(self, pattern, since=0):
        """Wait until the terminal has shown it; where the shown text then ends."""
        deadline = time.monotonic() + PATIENCE_S
        while not re.search(pattern, self._shown[since:]):
            assert time.monotonic() < deadline, f"{pattern!r} was never shown:\n{self._shown}"
            assert self.process.poll() is None, f"it ended without {pattern!r}:\n{self._shown}"
            time.sleep(0.02)
        return len(self._shown)

    def types(self, key):
        os.write(self._master, key)

    def holds(self, key, until):
        """Hold a key down until the terminal shows a pattern; the seconds it was held for."""
        begun, since = time.monotonic(), len(self._shown)
        while not re.search(until, self._shown[since:]):
            assert time.monotonic() - begun < PATIENCE_S, f"{until!r} never came:\n{self._shown}"
            self.types(key)
            time.sleep(REPEAT_S)
        return time.monotonic() - begun

    def types_after(self, pattern, key):
        self.sees(pattern)
        self.types(key)

    def ends(self):
        """Wait for the end: exit code and everything that was shown."""
        code = self.process.wait(PATIENCE_S)
        time.sleep(0.1)
        return code, self._shown

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()
        print(self._shown)
        os.close(self.slave)

    def _read(self):
        while True:
            try:
                typed = os.read(self._master, 4096)
            except OSError:
                return
            if not typed:
                return
            self._shown += typed.decode(errors="replace")
