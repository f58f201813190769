"""A method under test: its input, its possible answers, and a separate process in which it runs."""

import contextlib
import inspect
import math
import os
import pickle
import queue
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from jaxtyping import Float

from rotflex_jax.arena.simulator.laws import Place
from rotflex_jax.checks import real, shown
from rotflex_jax.effects import CATALOG
from rotflex_jax.errors import InputError
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording

Method = Callable[..., Any]
"""`method(train, validation, model)` or `method(train, validation)`: lists of recordings, textbook model."""

NOTHING_MISSING, UNEXPLAINED = "nothing missing", "unexplained"
_KEYS = ("effects", "unexplained", "probabilities", "model")
# Amount by which a probability may exceed one because of rounding.
_ROUNDING = 1e-9
# Time that a process may take to start and import, or to run a model [s].
_STARTING = 300.0


class ArenaFailure(Exception):
    """A method gave no answer; the message is a sentence with the reason."""


@dataclass(frozen=True)
class Answer:
    """The answer of a method on a record.

    Attributes:
        effects: Missing effects, by name and port.
        unexplained: Whether the method states that something remains unexplained.
        probabilities: Effect at a port -> probability that it is present.
        has_model: Whether the answer includes a model to run.
        seconds: Time that the answer took [s].
    """

    effects: tuple[Place, ...] = ()
    unexplained: bool = False
    probabilities: dict[Place, float] = field(default_factory=dict)
    has_model: bool = False
    seconds: float = 0.0


def place_of(given: Any, model: Model) -> Place:
    """An effect and its port, from `"coulomb@hub"` or `("coulomb", "hub")`.

    Raises:
        InputError: The effect is not in the catalogue, or cannot act at the port.
    """
    pair = tuple(given.split("@")) if isinstance(given, str) else given
    if not (isinstance(pair, tuple | list) and len(pair) == 2 and all(isinstance(x, str) for x in pair)):
        raise InputError(
            f"An effect is named as 'coulomb@hub', but the answer has {shown(given)}; give name and port."
        )
    name, port = pair
    if name not in CATALOG:
        raise InputError(
            f"The answer names {shown(name)}, but the catalogue has no such effect; `rotflex effects` lists "
            "those that it has."
        )
    ports = model.mechanism.locations(CATALOG[name])
    if port not in ports:
        raise InputError(
            f"The answer names {name} at {shown(port)}, but this machine has {', '.join(map(repr, ports))} "
            "for it; name one of these."
        )
    return name, port


def understood(given: Any, model: Model) -> tuple[Answer, Any]:
    """The answer and the model in the return value of a method.

    Args:
        given: "nothing missing", "unexplained", a list of effects, or a mapping with `effects` and optionally
            `unexplained`, `probabilities` and `model`.
        model: The textbook model that the method received.

    Raises:
        InputError: The return value is none of these.
    """
    if isinstance(given, str):
        words = {NOTHING_MISSING: {"effects": []}, UNEXPLAINED: {"unexplained": True}}
        phrase = given.replace("_", " ").strip().lower()
        if phrase not in words and "@" not in given:
            raise InputError(
                f"The answer is {shown(given)}, but a text must be 'nothing missing', 'unexplained' or an "
                "effect such as 'coulomb@hub'; return one of these, or a list of effects."
            )
        given = words.get(phrase, {"effects": [given]})
    elif isinstance(given, Iterable) and not isinstance(given, Mapping | bytes):
        given = {"effects": list(given)}
    if not isinstance(given, Mapping):
        raise InputError(
            f"The answer is {shown(given)}, but a list of effects, 'nothing missing', 'unexplained' or a "
            "mapping is needed; return for instance ['coulomb@hub']."
        )
    unknown = [k for k in given if k not in _KEYS]
    if unknown:
        raise InputError(
            f"The answer has the key {shown(unknown[0])}, but only {', '.join(_KEYS)} are known; drop it."
        )
    effects = given.get("effects") or ()
    if isinstance(effects, str):
        effects = [effects]
    if not isinstance(effects, Iterable):
        raise InputError(f"The effects are {shown(effects)}, but a list is needed; give ['coulomb@hub'].")
    places = dict.fromkeys(place_of(e, model) for e in effects)
    unexplained = given.get("unexplained", False)
    if not isinstance(unexplained, bool | np.bool_):
        raise InputError(
            f"`unexplained` is {shown(unexplained)}, but must be True or False; give one of them."
        )
    chances = given.get("probabilities") or {}
    if not isinstance(chances, Mapping):
        raise InputError(
            f"`probabilities` are {shown(chances)}, but a mapping from effects to numbers is needed; give "
            "for instance {'coulomb@hub': 0.9}."
        )
    for value in chances.values():
        if not 0 <= real(value) <= 1 + _ROUNDING:
            raise InputError(f"A probability is {shown(value)}, but must lie between 0 and 1; correct it.")
    found, answered = {place_of(k, model): min(float(v), 1.0) for k, v in chances.items()}, given.get("model")
    if answered is not None and not callable(getattr(answered, "simulate", None)):
        try:
            answered = Model.of(answered)
        except InputError:
            raise InputError(
                f"The model is {shown(answered)}, but a rotflex_jax model or an object with "
                "simulate(recording) is needed; return one of these, or leave it out."
            ) from None
    return Answer(tuple(places), bool(unexplained), found, answered is not None), answered


def called(method: Method, train: list[Recording], validation: list[Recording], model: Model) -> Any:
    """The return value of a method, which receives the textbook model if it has a third argument."""
    try:
        parameters = list(inspect.signature(method).parameters.values())
    except (TypeError, ValueError):
        parameters = []
    by_place = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    # An argument with a default value is not meant for the model, unless its name is `model`.
    needed = [
        p
        for p in parameters
        if p.kind in by_place and (p.default is inspect.Parameter.empty or p.name == "model")
    ]
    many = any(p.kind is inspect.Parameter.VAR_POSITIONAL for p in parameters)
    return method(train, validation, model) if many or len(needed) != 2 else method(train, validation)


def simulated(model: Any, recordings: list[Recording]) -> list[Float[np.ndarray, "_ C"]]:
    """Free runs of the model in an answer.

    Raises:
        InputError: A run does not have the shape of its recording.
    """
    runs = []
    for r in recordings:
        run = np.asarray(model.simulate(r), float)
        if run.shape != r.y.shape:
            raise InputError(
                f"A free run of the model has the shape {run.shape}, but {r.y.shape} is needed; simulate "
                "every sample and channel of the recording."
            )
        runs.append(run)
    return runs


def _said(problem: BaseException) -> str:
    """An exception as one line."""
    text = " ".join(str(problem).split())
    if isinstance(problem, InputError):
        return text
    where = f"{type(problem).__name__}: {text}" if text else type(problem).__name__
    return f"The method raised {where[:300]}."


class Here:
    """A method in this process, for functions of the caller; the time limit is checked only afterwards."""

    def __init__(self, method: Method) -> None:
        self.method, self.model = method, None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.model = None

    def answer(self, given: bytes, limit: float) -> Answer:
        """The answer to a record.

        Raises:
            ArenaFailure: There is no valid answer.
        """
        self.model = None
        train, validation, model = pickle.loads(given)
        began = time.perf_counter()
        try:
            raw = called(self.method, train, validation, model)
            seconds = time.perf_counter() - began
            found, self.model = understood(raw, model)
        except Exception as problem:
            raise ArenaFailure(_said(problem)) from problem
        if seconds > limit:
            raise ArenaFailure(_late(limit))
        return Answer(found.effects, found.unexplained, found.probabilities, found.has_model, seconds)

    def simulate(self, asked: bytes) -> list[Float[np.ndarray, "_ C"]]:
        """Free runs of the model of the last answer.

        Raises:
            ArenaFailure: The model does not run.
        """
        try:
            return simulated(self.model, pickle.loads(asked))
        except Exception as problem:
            raise ArenaFailure(_said(problem)) from problem


def _late(limit: float) -> str:
    return f"The method took longer than {limit:g} s."


class Apart:
    """A method in a separate process, which receives recordings and nothing else.

    The process can be stopped at any time without affecting anything else; the next record then gets a new
    process.

    Args:
        name: `FILE.py:NAME`, or an entrant of `rotflex_jax.arena`.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.process: subprocess.Popen[bytes] | None = None
        self.started = False
        self.replies: queue.Queue[tuple[str, Any]] = queue.Queue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    def _stop(self) -> None:
        process, self.process = self.process, None
        if process is not None:
            # Including all processes that the method started; macOS refuses a group without live processes.
            if hasattr(os, "killpg"):
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    with contextlib.suppress(OSError):
                        pipe.close()

    def _start(self) -> None:
        """Start a process and let it import the method.

        Raises:
            InputError: The method cannot be imported.
        """
        root = str(Path(__file__).resolve().parents[2])
        path = os.pathsep.join(p for p in (root, os.environ.get("PYTHONPATH", "")) if p)
        code = "from rotflex_jax.arena.method import serve; serve()"
        self.process = subprocess.Popen(
            [sys.executable, "-c", code, self.name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": path},
            start_new_session=True,  # a separate process group, which can be stopped as a whole
        )
        self.replies = queue.Queue()
        assert self.process.stdout is not None
        reader = threading.Thread(target=_listen, args=(self.process.stdout, self.replies), daemon=True)
        reader.start()
        word, sentence = self._reply(_STARTING, "start")
        if word != "ready":
            self._stop()
            raise InputError(sentence if word == "refused" else f"{self.name} cannot be used: {sentence}")
        self.started = True

    def _reply(self, limit: float, what: str) -> tuple[str, Any]:
        try:
            return self.replies.get(timeout=limit)
        except queue.Empty:
            self._stop()
            late = _late(limit) if what == "answer" else f"It took longer than {limit:g} s to {what}."
            return "failed", late

    def _ask(self, request: tuple[str, bytes], limit: float) -> Any:
        if self.process is None:
            try:
                self._start()
            except (InputError, OSError) as problem:
                if not self.started:
                    raise
                # The import worked before, so the failure concerns only this record; others may continue.
                raise ArenaFailure(f"The process of the method does not start again: {problem}") from problem
        process = self.process
        assert process is not None and process.stdin is not None
        try:
            _send(process.stdin, request)
            word, value = self._reply(limit, request[0])
        except OSError:
            word, value = "ended", None
        if word == "ended":
            code = process.wait()
            self._stop()
            raise ArenaFailure(f"The process of the method ended by itself, with status {code}.")
        if word != "done":
            raise ArenaFailure(value)
        return value

    def begin(self) -> None:
        """Import the method, so that its errors are reported before any record.

        Raises:
            InputError: The method cannot be imported.
        """
        if self.process is None:
            self._start()

    def answer(self, given: bytes, limit: float) -> Answer:
        """As `Here.answer`, but a method that takes too long is stopped."""
        return self._ask(("answer", given), limit)

    def simulate(self, asked: bytes) -> list[Float[np.ndarray, "_ C"]]:
        """As `Here.simulate`."""
        return self._ask(("simulate", asked), _STARTING)


def _send(pipe: IO[bytes], value: Any) -> None:
    data = pickle.dumps(value)
    pipe.write(struct.pack("<Q", len(data)) + data)
    pipe.flush()


def _receive(pipe: IO[bytes]) -> Any:
    """The next message; None at the end."""
    head = pipe.read(8)
    if len(head) < 8:
        return None
    (size,) = struct.unpack("<Q", head)
    data = pipe.read(size)
    return pickle.loads(data) if len(data) == size else None


def _listen(pipe: IO[bytes], replies: "queue.Queue[tuple[str, Any]]") -> None:
    """Passes on the messages of a process until it ends."""
    with contextlib.suppress(OSError, ValueError, EOFError, pickle.UnpicklingError):
        while (message := _receive(pipe)) is not None:
            replies.put(message)
    replies.put(("ended", None))


def check_name(name: str) -> None:
    """Refuse a name that is neither an entrant nor the name of a function in a file.

    Raises:
        InputError: The name is neither.
    """
    from rotflex_jax.arena.entrants import ENTRANTS  # on request: it names methods

    if name not in ENTRANTS and not name.rpartition(":")[0]:
        raise InputError(
            f"The method {shown(name)} is neither FILE.py:NAME nor one of {', '.join(ENTRANTS)}; name the "
            "function behind a colon."
        )


def loaded(name: str) -> Method:
    """The method of `FILE.py:NAME`, `package.module:NAME` or the name of an entrant.

    Raises:
        InputError: There is no such method, or it is no function.
    """
    from rotflex_jax.arena.entrants import ENTRANTS
    from rotflex_jax.joints.by_name import imported

    check_name(name)
    if name in ENTRANTS:
        return ENTRANTS[name].method
    place, _, attribute = name.rpartition(":")
    method = getattr(imported(place), attribute, None)
    if not callable(method):
        raise InputError(f"{place} has no function {shown(attribute)}; name one that it has.")
    return method


def serve() -> None:
    """Main function of the process of a method: answers until its input ends; prints go to stderr."""
    answers, questions = os.fdopen(os.dup(1), "wb"), os.fdopen(os.dup(0), "rb")
    os.dup2(2, 1)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    try:
        from rotflex_jax.runtime.xla import enable_fast_start

        enable_fast_start()
        here = Here(loaded(sys.argv[1]))
    except InputError as problem:
        _send(answers, ("refused", str(problem)))
        return
    except BaseException as problem:
        _send(answers, ("failed", _said(problem)))
        return
    _send(answers, ("ready", ""))
    while (request := _receive(questions)) is not None:
        word, data = request
        try:
            done = here.answer(data, math.inf) if word == "answer" else here.simulate(data)
            _send(answers, ("done", done))
        except ArenaFailure as problem:
            _send(answers, ("failed", str(problem)))
        except KeyboardInterrupt:
            return
        except SystemExit as problem:
            _send(answers, ("failed", f"The method left with SystemExit({problem.code})."))
