"""Ctrl-C ends the command line at once; rounds of a search that are done stay in a file.

An exception would arrive in the middle of an import, in a callback of the garbage collector, or only after a
minute of compiled code, and end with a traceback in some of these. Files are written whole or not at all and
results as soon as they are there, so that an end at any moment costs only what was not finished.
"""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from rotflex_jax.errors import InputError
from rotflex_jax.text.files import write_file

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


class RoundsSoFar:
    """Keeps the models that a search has reached in `NAME.stopped.json`, beside its result to be.

    A result of an earlier search stays as it is until the new one is complete.

    Args:
        json_file: Where the result goes; None or "-" where it goes to no file, and nothing is kept.
    """

    def __init__(self, json_file: Path | None) -> None:
        self.file = None
        if json_file is not None and str(json_file) != "-" and not _is_special(json_file):
            self.file = json_file.with_name(f"{json_file.stem}.stopped.json")
        self._stages: list[dict[str, Any]] = []

    def following(self, step: Callable[[str], None]) -> Callable[[str], None]:
        """The same function of a line of progress; lines that tell of a model reached are kept too."""

        def follow(line: str) -> None:
            errors = getattr(line, "errors", None)
            if self.file is not None and errors is not None:
                label = str(getattr(line, "label", ""))
                stage = {"model": label, "held_out_rmse_windows": dict(errors)}
                if found := getattr(line, "kept", None):
                    stage["search"] = found
                self._stages.append(stage)
                self._write(self.file)
            step(line)

        return follow

    def _write(self, file: Path) -> None:
        # A search that goes on comes by the rounds of the file again, and must not lose them if it is killed.
        stages = _longer(file, self._stages) or self._stages
        kept = {"schema": 1, "stopped": True, "stages": stages}
        if stages is self._stages:
            try:
                write_file(file, json.dumps(kept, indent=2) + "\n")
            except InputError:
                return  # the search is worth more than its trace
        done = len(stages) - 1
        rounds = "one finished round" if done == 1 else f"{done} finished rounds"
        STOP.kept = (
            f"the model as it is and after {rounds} are in {file}: the same command with --continue goes on "
            "from there"
        )

    def remove(self) -> None:
        """Nothing is kept of a search that has ended."""
        STOP.kept = ""
        if self.file is not None and self._stages:
            self.file.unlink(missing_ok=True)


def _longer(file: Path, stages: list[dict[str, Any]]) -> list[Any] | None:
    """What a file has kept of the same search, where that begins with these stages and has more of them."""
    try:
        known = json.loads(file.read_text(encoding="utf-8"))["stages"]
        begins = [(a["model"], a["search"]["digest"]) for a in known[: len(stages)]]
        same = begins == [(a["model"], a["search"]["digest"]) for a in stages]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return known if same and len(known) > len(stages) else None


def _is_special(path: Path) -> bool:
    """A device or a pipe, beside which nothing is kept."""
    return path.exists() and not path.is_file()
