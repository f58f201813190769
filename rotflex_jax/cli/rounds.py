"""Finished rounds of a search are kept in a file until the search has ended."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rotflex_jax.cli.stopping import STOP
from rotflex_jax.errors import InputError
from rotflex_jax.text.files import write_file
from rotflex_jax.text.numbers import json_numbers


class RoundsSoFar:
    """Keeps the models that a search has reached in `NAME.stopped.json`, beside the file of its result.

    A result of an earlier search stays as it is until the new one is complete.

    Args:
        json_file: File of the result. With None or "-" there is no such file, and nothing is kept.
    """

    def __init__(self, json_file: Path | None) -> None:
        self.file = None
        if json_file is not None and str(json_file) != "-" and not _is_special(json_file):
            self.file = json_file.with_name(f"{json_file.stem}.stopped.json")
        self._stages: list[dict[str, Any]] = []

    def following(self, step: Callable[[str], None]) -> Callable[[str], None]:
        """A function that passes lines of progress to `step` and keeps the models that they report."""

        def follow(line: str) -> None:
            errors = getattr(line, "errors", None)
            if self.file is not None and errors is not None:
                label = str(getattr(line, "label", ""))
                stage = {"model": label, "held_out_rmse_windows": json_numbers(errors)}
                if found := getattr(line, "kept", None):
                    stage["search"] = found
                self._stages.append(stage)
                self._write(self.file)
            step(line)

        return follow

    def _write(self, file: Path) -> None:
        # A continued search passes the rounds of the file again, and must not lose them if it is killed.
        stages = _longer(file, self._stages) or self._stages
        kept = {"schema": 1, "stopped": True, "stages": stages}
        if stages is self._stages:
            try:
                write_file(file, json.dumps(kept, indent=2) + "\n")
            except InputError:
                return  # a file that cannot be written must not end the search
        done = len(stages) - 1
        rounds = "one finished round" if done == 1 else f"{done} finished rounds"
        STOP.kept = (
            f"the model as it is and after {rounds} are in {file}: the same command with --continue goes on "
            "from there"
        )

    def remove(self) -> None:
        """Remove the file of a search that has ended."""
        STOP.kept = ""
        if self.file is not None and self._stages:
            self.file.unlink(missing_ok=True)


def _longer(file: Path, stages: list[dict[str, Any]]) -> list[Any] | None:
    """Stages of the same search in a file, if they begin with these stages and are more; otherwise None."""
    try:
        known = json.loads(file.read_text(encoding="utf-8"))["stages"]
        begins = [(a["model"], a["search"]["digest"]) for a in known[: len(stages)]]
        same = begins == [(a["model"], a["search"]["digest"]) for a in stages]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return None
    return known if same and len(known) > len(stages) else None


def _is_special(path: Path) -> bool:
    """Whether a path is a device or a pipe, beside which nothing is kept."""
    return path.exists() and not path.is_file()
