"""Ctrl-C ends the command line at once, also where compiled code does not listen.

An exception would arrive in the middle of an import, in a callback of the garbage collector, or only after a
minute of compiled code, and end with a traceback in some of these. Files are written whole or not at all and
results as soon as they are there, so that an end at any moment costs only what was not finished.
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
        with suppress(Exception):
            sys.stdout.flush()
        # The line of a spinner is cleared, and the cursor that it has hidden comes back.
        clear = "\r\x1b[K\x1b[?25h" if os.isatty(2) else ""
        with suppress(OSError):
            os.write(2, f"{clear}rotflex: stopped{f'; {self.kept}' if self.kept else ''}\n".encode())
        with suppress(Exception):
            if "multiprocessing.process" in sys.modules:
                from multiprocessing import active_children

                for child in active_children():
                    child.kill()
            if "rotflex_jax.text.files" in sys.modules:
                from rotflex_jax.text.files import UNFINISHED

                for part in list(UNFINISHED):
                    part.unlink(missing_ok=True)
        os._exit(STOPPED)


STOP = Stop()
"""Of this process."""
