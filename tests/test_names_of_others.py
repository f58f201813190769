"""Names from files become no code in an export, no command for a terminal and no formula in a table."""

import csv
import io
import re
from pathlib import Path

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.batch.result import Fleet, RecordingRow
from rotflex_jax.cli import main
from rotflex_jax.cli.terminal import save_simulation
from rotflex_jax.data.excitation import noise
from rotflex_jax.effects import Coulomb, CubicSpring, Inertia, Motor, Spring
from rotflex_jax.export import latex, text, to_c
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.models.model import Model
from rotflex_jax.text.numbers import one_line, printable, spreadsheet_cell

HOSTILE = (
    "arm */ static int owned(void) { return 1; } /*",
    "arm \\*/ int owned; /*",
    "arm\nint owned;",
    "arm *\\\n/ int owned; /*",
    "arm /* // int owned",
)


def machine(port: str, unit: str = "V") -> Model:
    return Model(
        rf.Mechanism(
            coordinates=(port,),
            ports={port: (1.0,)},
            effects=(
                Inertia(at=port, inertia=0.01),
                Motor(at=port),
                Spring(at=port, stiffness=1.0),
                Coulomb(at=port, level=0.01),
                CubicSpring(at=port, stiffness=2.0),
            ),
            outputs={port: port},
            units=Units(input=unit),
        )
    )


def without_comments(code: str) -> str:
    """Code after the first steps of a C compiler: lines are joined at a backslash, then comments removed."""
    return re.sub(r"/\*.*?\*/", "", code.replace("\\\n", ""), flags=re.DOTALL)


@pytest.mark.parametrize("name", HOSTILE)
def test_no_name_becomes_code_of_a_controller(name: str) -> None:
    plain = without_comments(to_c(machine("arm"), 0.002))
    assert without_comments(to_c(machine(name, unit=name), 0.002)) == plain
    assert "owned" not in plain


LATEX_NAMES = (r"\input{/etc/passwd}", "a} \\write18{ls} {", "a\n\\input{x}", "50 %", "a_b^c~d#e$f&g")


@pytest.mark.parametrize("name", LATEX_NAMES)
def test_no_name_becomes_a_command_of_latex(name: str) -> None:
    made = latex(machine(name))
    for command in ("input", "write"):
        assert not re.search(rf"(?<!textbackslash\{{\}}){command}\\?[{{1]", re.sub("(?m)^%.*$", "", made))
    # Braces that are not part of a name are balanced, and a line break in a name begins no new line.
    bare = re.sub(r"\\[{}]", "", re.sub("(?m)^%.*$", "", made))
    assert bare.count("{") == bare.count("}")
    assert len(made.splitlines()) == len(latex(machine("arm")).splitlines())
    assert len(text(machine(name)).splitlines()) == len(text(machine("arm")).splitlines())


def test_codes_of_a_terminal_are_shown_not_sent() -> None:
    sent = "run\x1b]0;owned\x07\x9b2J\u202egpj.csv\r\b"
    assert printable(sent) == r"run\x1b]0;owned\x07\x9b2J\u202egpj.csv\r\x08"
    assert printable("a\tb\nΔθ [°]") == "a\tb\nΔθ [°]"
    assert one_line("a\tb\nc") == r"a\tb\nc"


def recorded(folder: Path, name: str) -> Path:
    u = noise(3000, 0.002, seed=4)
    y = rf.simulate(rf.joints.paper(), u, 0.002)
    rf.data.save_csv(rf.Recording(u=u, y=y, Ts=0.002), folder / name)
    return folder / name


@pytest.mark.parametrize(
    "line", [["check"], ["check", "--input", "u\x1b[2J"], ["check", "--output", "\x1b]0;x\x07"]]
)
def test_codes_in_the_name_of_a_file_do_not_reach_the_terminal(
    line: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = recorded(tmp_path, "run\x1b[31mred\x07.csv")
    for path in (file, tmp_path / "missing\x1b[2J.csv"):
        with pytest.raises(SystemExit):
            main([line[0], str(path), *line[1:]])
        shown = "".join(capsys.readouterr())
        assert shown and "\\x1b" in shown
        assert not re.search("[\x00-\x08\x0b-\x1f\x7f-\x9f]", shown)


def test_no_cell_of_a_summary_is_a_formula(tmp_path: Path) -> None:
    row = RecordingRow(
        "=1+1",
        '=cmd|"/c calc"!A1',
        verdict="found",
        effects=(("@evil", "hub", ()),),
        before={"-theta": -1.0},
        reason="+more\x1b[2J",
    )
    fleet = Fleet((row,), 1, {"-theta": "rad"}, tmp_path, 0.0)
    head, cells = csv.reader(io.StringIO(fleet.to_csv()))
    found = dict(zip(head, cells, strict=True))
    assert found["name"] == "'=1+1" and found["source"] == '\'=cmd|"/c calc"!A1'
    assert found["effects"] == "'@evil@hub" and found["reason"] == r"'+more\x1b[2J"
    assert found["'-theta_before"] == "-1.0"  # a number is not a formula
    assert spreadsheet_cell("run") == "run"


def test_columns_of_a_simulation_are_no_formulas(tmp_path: Path) -> None:
    recording = rf.Recording(
        u=np.sin(np.arange(60.0)),
        y=np.cos(np.arange(60.0)),
        Ts=0.1,
        channels='=1,"2"',
        input_name="@u",
        accept=("saturated",),
    )
    save_simulation(tmp_path / "run.csv", recording, {'=1,"2"': recording.u})
    (head, *rows) = csv.reader((tmp_path / "run.csv").read_text().splitlines())
    assert head == ["t", "'@u", '\'=1,"2"', '\'=1,"2"_simulated']
    assert {len(row) for row in rows} == {4} and len(rows) == 60
