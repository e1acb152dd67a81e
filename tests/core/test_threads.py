"""The end of a program in which a package has left a thread running."""

from __future__ import annotations

import threading

from rig.core.threads import thread_remains


def test_a_thread_that_a_package_has_left_is_named_and_not_waited_for_for_ever() -> None:
    said: list[str] = []
    may_end = threading.Event()
    daemon = threading.Thread(target=may_end.wait, daemon=True)
    upload = threading.Thread(target=may_end.wait, name="upload")
    daemon.start()
    try:
        assert not thread_remains(said.append), "Python does not wait for a daemon"
        upload.start()
        assert thread_remains(said.append, patience_s=0.6)
    finally:
        may_end.set()
    (warning,) = said
    assert "a package has left a thread running ('upload')" in warning
    assert not thread_remains(said.append), "it has ended meanwhile"
