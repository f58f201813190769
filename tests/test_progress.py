"""What is said while a user waits: how long it takes, never nothing for long, and no made-up numbers."""

import time

import pytest

from rotflex_jax.cli import terminal
from rotflex_jax.discover.checkpoint import TimeLeft, beginning


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_time_left_is_that_of_the_steps_measured() -> None:
    clock = Clock()
    left = TimeLeft(clock)

    def after(seconds: float, kind: str) -> float | None:
        clock.now += seconds
        left.follow(beginning(kind, kind))  # pyright: ignore[reportArgumentType]
        return left.seconds()

    # The first steps compile; nobody knows how long.
    assert (left.seconds(), after(1, "baseline"), after(30, "score"), after(20, "refit")) == (None,) * 4
    assert left.words() == "51 s so far"
    # 40 s of refits were measured. A second round if it is the last one: scores, refits, and two more steps
    # of refits, for which nothing else is known yet.
    assert after(40, "score") == 20 + 3 * 40
    clock.now += 15
    left.follow("  a line of no step")
    assert left.seconds() == 5 + 3 * 40
    assert left.words() == "106 s so far, about 2 min left if this round is the last"
    clock.now += 100  # longer than the first time: then nobody knows
    assert left.seconds() is None and left.words() == "206 s so far, longer than expected"
    # The last measurement of each kind counts: it did not compile.
    assert after(0, "refit") == 3 * 40 and after(10, "needed") == 2 * 10
    assert after(4, "finish") == 10 and left.words().endswith("about 10 s left")


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "SILENCE", 0.05)


def test_a_step_that_takes_long_is_said_again(impatient: None, capsys: pytest.CaptureFixture[str]) -> None:
    said = ""
    with terminal.progress("Searching") as step:
        step("refitting coulomb at hub")
        until = time.monotonic() + 30
        while "still" not in said and time.monotonic() < until:
            time.sleep(0.02)
            said += capsys.readouterr().err
    assert said.startswith("refitting Coulomb friction at hub (0 s so far)")
    assert "  still refitting Coulomb friction at hub (0 s; 0 s so far)" in said
    capsys.readouterr()
    time.sleep(0.15)
    assert capsys.readouterr().err == ""  # nothing more after the end


def test_a_long_line_is_shortened_when_it_is_said_again(
    impatient: None, capsys: pytest.CaptureFixture[str]
) -> None:
    told = terminal._Told("Searching")
    told.take("refitting " + ", ".join(f"effect{k} at hub" for k in range(20)))
    assert " … (0 s" in told.again() and len(told.again()) < 110
