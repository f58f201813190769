"""Ctrl-C ends the command line at once.

An exception would arrive in the middle of an import, in a callback of the garbage collector, or only after a
minute of compiled code, and end with a traceback in some of these. Files are written whole or not at all and
results as soon as they are there, so that an end at any moment costs only what was not finished. This module
imports as little as it can, since the signal is not heard before it is loaded.
"""

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from typing import Any, NoReturn

STOPPED = 130
"""Exit status of a program that was stopped by Ctrl-C."""

LONGEST_END = 0.5
"""Time after which a process that was stopped ends in any case [s]."""


class Stop:
    """The end of this process by Ctrl-C.

    Attributes:
        kept: What a user is told of results that were kept.
    """

    def __init__(self) -> None:
        self.kept = ""
        self._once = threading.Lock()

    def listen(self) -> None:
        """From now on Ctrl-C ends the process: in the main thread, or in one that waits for the signal."""
        if threading.current_thread() is not threading.main_thread():
            return
        signal.signal(signal.SIGINT, self)
        if os.name == "posix":
            source, sink = os.pipe()
            os.set_blocking(sink, False)
            # The signal writes to the pipe also while the main thread is in compiled code.
            signal.set_wakeup_fd(sink, warn_on_full_buffer=False)
            threading.Thread(target=self._wait, args=(source,), daemon=True).start()

    def _wait(self, source: int) -> None:
        while signal.SIGINT not in os.read(source, 64):
            pass
        self()

    def __call__(self, *_: Any) -> NoReturn:
        """Say so, end the worker processes, leave."""
        if not self._once.acquire(blocking=False):
            while True:  # the other thread is about to end the process
                time.sleep(1)
        # The other thread may hold a lock for good that is needed here, such as that of a pipe nobody reads.
        with suppress(Exception):
            limit = threading.Timer(LONGEST_END, os._exit, (STOPPED,))
            limit.daemon = True
            limit.start()
        # The line of a spinner is cleared, and the cursor that it has hidden comes back.
        clear = "\r\x1b[K\x1b[?25h" if os.isatty(2) else ""
        with suppress(OSError):
            os.write(2, f"{clear}rotflex: stopped{f'; {self.kept}' if self.kept else ''}\n".encode())
        # An import would wait for the main thread where that is importing the same module.
        with suppress(Exception):
            for child in getattr(sys.modules.get("multiprocessing.process"), "active_children", list)():
                child.kill()
            for part in list(getattr(sys.modules.get("rotflex_jax.text.files"), "UNFINISHED", ())):
                part.unlink(missing_ok=True)
            sys.stdout.flush()
        os._exit(STOPPED)


STOP = Stop()
"""Of this process."""
