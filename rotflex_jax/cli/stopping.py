"""Ctrl-C ends the command line at once.

A `KeyboardInterrupt` could arrive in the middle of an import, in a callback of the garbage collector, or only
after a minute of compiled code, and in some of these cases it ends with a traceback. Files are written
completely or not at all, and results are written as soon as they exist. So an end at any moment loses only
unfinished work. This module imports as little as possible, because Ctrl-C is not handled before it is loaded.
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
        kept: Message to the user about results that were kept.
    """

    def __init__(self) -> None:
        self.kept = ""
        self._once = threading.Lock()

    def listen(self) -> None:
        """From now on Ctrl-C ends the process, from the main thread or from a thread that waits for it."""
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
        """Print a message, end the worker processes and exit."""
        if not self._once.acquire(blocking=False):
            while True:  # the other thread is about to end the process
                time.sleep(1)
        # The other thread may hold a lock forever that is needed here, such as the lock of a pipe that nobody
        # reads.
        with suppress(Exception):
            limit = threading.Timer(LONGEST_END, os._exit, (STOPPED,))
            limit.daemon = True
            limit.start()
        # Clear the line of a spinner, and show the cursor that the spinner has hidden.
        clear = "\r\x1b[K\x1b[?25h" if os.isatty(2) else ""
        with suppress(OSError):
            os.write(2, f"{clear}rotflex: stopped{f'; {self.kept}' if self.kept else ''}\n".encode())
        # No import here: it would wait for the main thread if that is importing the same module.
        with suppress(Exception):
            for child in getattr(sys.modules.get("multiprocessing.process"), "active_children", list)():
                child.kill()
            for part in list(getattr(sys.modules.get("rotflex_jax.text.files"), "UNFINISHED", ())):
                part.unlink(missing_ok=True)
            sys.stdout.flush()
        os._exit(STOPPED)


STOP = Stop()
"""Of this process."""
