"""Documentation: quoted messages are raised, examples run, and links lead to existing places."""

import contextlib
import importlib
import io
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import pandas as pd
import pytest

import rotflex_jax as rf
from rotflex_jax.cli import app
from rotflex_jax.discover.reading import sign_note
from rotflex_jax.effects import CATALOG, LearnedTorque

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.glob("*.md"))
BESIDE = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
sys.path.append(str(DOCS))  # for `generate`, which makes the catalogue

N, TS = 400, 0.002
GOOD: dict[str, Any] = {
    "t": np.round(TS * np.arange(N), 6),
    "voltage": np.round(rf.data.excitation.noise(N, TS, seed=3), 4),
    "theta": 0.3 * np.sin(np.arange(N) / 40),
    "alpha": 0.05 * np.cos(np.arange(N) / 11),
}


def file(**columns: Any) -> str:
    """`run.csv` in the current folder, with other columns; None leaves one out."""
    frame = {name: column for name, column in {**GOOD, **columns}.items() if column is not None}
    pd.DataFrame(frame).to_csv("run.csv", index=False)
    return "run.csv"


def at(name: str, k: int, value: float) -> dict[str, Any]:
    """One value of a column replaced."""
    column = GOOD[name].copy()
    column[k] = value
    return {name: column}


def lines(edit: Callable[[list[str]], list[str]]) -> str:
    path = Path(file())
    path.write_text("\n".join(edit(path.read_text().splitlines())) + "\n")
    return str(path)


def frozen(x: np.ndarray) -> np.ndarray:
    """The same value for 0.2 s."""
    return np.where((np.arange(N) > 100) & (np.arange(N) <= 200), x[100], x)


def latin() -> str:
    header = "t [s],voltage [V],theta [°],alpha [°]"
    path = Path(lines(lambda rows: [header, *rows[1:]]))
    path.write_bytes(path.read_text().encode("latin-1"))
    return str(path)


def without(package: str, do: Callable[[], object]) -> object:
    """Call a function as on a machine that lacks a package."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, package, None)
        return do()


def hdf5() -> str:
    Path("run.mat").write_bytes(b"\x00" * 512 + b"\x89HDF\r\n\x1a\n" + b"\x00" * 600)
    return "run.mat"


def command(*arguments: str) -> None:
    """Run the command line; raise its message on stderr as an error."""
    said = io.StringIO()
    with contextlib.redirect_stderr(said), pytest.raises(SystemExit) as left:
        app.main(arguments)
    assert left.value.code == 2
    raise rf.InputError(said.getvalue().strip())


def recording(**columns: Any) -> rf.Recording:
    return rf.load(file(**columns))


def clipped() -> rf.Recording:
    k = np.arange(2000)
    y = np.column_stack([0.3 * np.sin(k / 40), np.minimum(0.3 * np.cos(k / 60), 0.2)])
    return rf.Recording(u=rf.data.excitation.noise(2000, TS, seed=3), y=y, Ts=TS)


def in_the_room() -> rf.Recording:
    """The demo recording with the absolute angle of the arm."""
    demo = rf.data.demo_recording()
    return rf.Recording(u=demo.u, y=demo.y @ np.array([[1.0, 1.0], [0.0, 1.0]]), Ts=demo.Ts)


def swapped() -> rf.Recording:
    """The demo recording with its columns in the wrong order, from a table."""
    demo = rf.data.demo_recording()
    named = {"t": demo.t, "voltage": demo.u, "theta": demo.y[:, 1], "alpha": demo.y[:, 0]}
    return rf.load(pd.DataFrame(named))


def doubted(recording: rf.Recording) -> None:
    """Raise the first warning about a recording as an error."""
    raise rf.InputError(next(str(f) for f in recording.findings if f.severity == "warning"))


def held() -> rf.Discovery:
    joint = rf.joints.paper()
    return rf.discover(joint.trust(*joint.free_names), recording(), recording())


def sindy() -> None:
    (row,) = rf.compare(recording(), ["sindy"]).rows
    raise rf.InputError(row.reason)


def turned(u: float, *y: float) -> rf.Fit:
    """A fit of the demo recording with reversed signs of input or outputs."""
    demo = rf.data.demo_recording()
    return rf.fit(rf.joints.paper(), rf.Recording(u=u * demo.u, y=demo.y * y, Ts=demo.Ts))


RAISED: dict[str, Callable[[], object]] = {
    "other names": lambda: rf.load(file(theta=None, angle=GOOD["theta"])),
    "many other names": lambda: rf.load(
        file(t=None, clock=GOOD["t"], voltage=None, u=GOOD["voltage"], theta=None, hub=GOOD["theta"])
    ),
    "line of remarks": lambda: rf.load(lines(lambda rows: [rows[0], "s,V,rad,rad", "run 3,,,", *rows[1:]])),
    "degrees by unit": lambda: rf.load(
        lines(lambda rows: [rows[0], "s,V,rad,rad", *rows[1:]]), units={"theta": "deg"}
    ),
    "degrees in the recording": lambda: rf.Model(rf.joints.paper(sensors="theta")).simulate(
        rf.Recording(GOOD["voltage"], GOOD["theta"], 0.002, "theta", "deg")
    ),
    "two names in one": lambda: rf.load(file(), outputs="theta,alpha"),
    "in the room": lambda: doubted(in_the_room()),
    "counts": lambda: rf.load(file(theta=np.round(4096 / 6.28 * GOOD["theta"]))),
    "swapped": swapped,
    "milliseconds by name": lambda: rf.load(file(t=None, t_ms=1000 * GOOD["t"]), time="t_ms", time_unit="s"),
    "no time": lambda: rf.load(file(t=None)),
    "no header": lambda: rf.load(lines(lambda rows: rows[1:])),
    "degrees by name": lambda: rf.load(
        file(theta=None, theta_rad=GOOD["theta"]), outputs=("theta_rad", "alpha"), degrees=True
    ),
    "degrees by size": lambda: recording(alpha=np.rad2deg(2 * GOOD["alpha"])),
    "millivolts": lambda: recording(voltage=1000 * GOOD["voltage"]),
    "milliseconds": lambda: recording(t=1000 * GOOD["t"]),
    "slow": lambda: rf.load(pd.DataFrame(GOOD).drop(columns="t"), Ts=2.0),
    "wrong unit of the time": lambda: rf.load(file(t=1000 * GOOD["t"]), time_unit="us"),
    "another encoding": lambda: rf.load(latin()),
    "nan": lambda: recording(**at("alpha", 120, np.nan)),
    "gap": lambda: rf.load(lines(lambda rows: rows[:200] + rows[206:])),
    "jitter": lambda: recording(**at("t", 120, GOOD["t"][120] + 0.0003)),
    "rounded time": lambda: recording(t=np.round(GOOD["t"], 2)),
    "constant input": lambda: recording(voltage=np.full(N, 1.0)),
    "dead sensor": lambda: recording(alpha=np.zeros(N)),
    "saturated": clipped,
    "deflection turned round": lambda: turned(1, 1, -1),
    "voltage turned round": lambda: turned(-1, 1, 1),
    "wrapped": lambda: recording(theta=(GOOD["theta"] * 20 + np.pi) % (2 * np.pi) - np.pi),
    "outliers": lambda: recording(**at("alpha", 120, -9999.0)),
    "frozen": lambda: recording(**{name: frozen(GOOD[name]) for name in ("theta", "alpha")}),
    "short": lambda: rf.load(lines(lambda rows: rows[:41])),
    "channels": lambda: rf.Model(rf.joints.paper()).simulate(
        rf.load(file(), outputs={"hub": "theta", "tip": "alpha"})
    ),
    "no port": lambda: rf.joints.paper() + rf.effects.Coulomb(at="motor"),
    "negative level": lambda: rf.effects.Coulomb("hub", level=-0.1),
    "all trusted": held,
    "no h5py": lambda: without("h5py", lambda: rf.load(hdf5())),
    "no pysindy": lambda: without("pysindy", sindy),
    "no file": lambda: command("discover", "rnu.csv"),
    "effect without a port": lambda: command("simulate", file(), "--add", "coulomb"),
}

# Messages of a search that are no errors.
SAID: dict[str, Callable[[], tuple[str, ...]]] = {
    "alpha turned round": lambda: sign_note(
        {"alpha": (np.deg2rad(0.762), np.deg2rad(0.405))}, {"theta": "rad", "alpha": "rad"}, 2.0
    ),
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An empty folder to work in; afterwards the catalogue is restored."""
    monkeypatch.chdir(tmp_path)
    known = dict(CATALOG)
    yield tmp_path
    CATALOG.clear()
    CATALOG.update(known)


def blocks(page: str, language: str) -> list[str]:
    """Fenced blocks that are not marked as long."""
    text = (DOCS / page).read_text()
    found = re.findall(rf"(<!-- long[^>]*-->\n)?^```{language}\n(.*?)^```", text, re.S | re.M)
    return [block for long, block in found if not long]


def test_every_message_that_is_quoted_is_really_raised_and_the_other_way_round(folder: Path) -> None:
    said = {}
    for kind, do in RAISED.items():
        with pytest.raises(rf.InputError) as caught:
            do()
        said[kind] = str(caught.value)
    notes = [note for say in SAID.values() for note in say()]
    quoted = [block.strip() for block in blocks("troubleshooting.md", "text")]
    assert sorted(quoted) == sorted([*said.values(), *notes])


@pytest.mark.parametrize(
    "page", ["first_look.md", "load_data.md", "add_effect.md", "from_matlab.md", "troubleshooting.md"]
)
def test_examples_run_as_they_stand(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # These two change settings of the process, which other tests share.
    monkeypatch.setattr(rf, "enable_fast_loops", lambda: True)
    monkeypatch.setattr(rf, "enable_compilation_cache", lambda: None)
    namespace: dict[str, Any] = {"__name__": "example"}
    examples = blocks(page, "python")
    assert examples
    for example in examples:
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(example, page, "exec"), namespace)


def anchors(page: Path) -> set[str]:
    """Anchors of a page: its headings as a code host converts them."""
    titles = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", page.read_text(), flags=re.S | re.M), re.M)
    return {re.sub(r"[^\w\- ]", "", t.replace("`", "").lower()).replace(" ", "-") for t in titles}


@pytest.mark.parametrize("page", [*PAGES, *BESIDE], ids=lambda p: p.name)
def test_relative_links_lead_somewhere(page: Path) -> None:
    text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text(), flags=re.S | re.M)
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        place, _, anchor = unquote(target).partition("#")
        there = (page.parent / place).resolve() if place else page
        if not there.exists() or (anchor and there.suffix == ".md" and anchor not in anchors(there)):
            broken.append(target)
    assert broken == []
    # Pages that are generated with the site do not exist on a code host.
    assert not re.search(r"\]\((docs/)?(effects|reference)/", text)


def test_the_numbers_of_the_decision_are_those_of_the_code() -> None:
    from rotflex_jax.discover import result, selection, verdict

    text = (DOCS / "method.md").read_text()
    rows = dict(re.findall(r"\| ([\d.]+) \| `selection\.(\w+)` \|", text))
    assert {name: getattr(selection, name) for name in rows.values()} == {
        n: float(v) for v, n in rows.items()
    }
    assert len(rows) == 4
    assert f"within {result.NEAR_FLOOR:g} times the noise" in text
    assert f"less than {verdict.TORQUE_NATS:g} nat" in text
    assert selection.SEPARATE_Z == 2.0 and "less than two standard deviations" in text


def test_the_catalogue_shows_every_effect_with_all_its_parameters() -> None:
    catalogue, figures = (
        importlib.import_module(f"generate.{name}") for name in ("catalogue", "effect_figures")
    )
    shown = catalogue.shown()
    assert (DOCS / "catalogue.md").read_text(encoding="utf-8") == catalogue.overview(), "build the site once"
    own = {name for name, cls in CATALOG.items() if cls.__module__.startswith("rotflex_jax.")}
    assert {cls.name for cls in shown} == own | {LearnedTorque.name}
    for cls in shown:
        page = catalogue._page(cls)
        for name, spec in cls.declared().items():
            assert f"``{name}``" in page
            assert spec.meaning in page
        assert ":Source: " in page and "none given" not in page
        assert f".. figure:: {cls.name}.svg" in page
    for cls in shown[::6]:  # the site draws all of them
        for ax in figures.figure(cls).axes:
            assert re.search(r"\[.+\]", ax.get_xlabel()) and re.search(r"\[.+\]", ax.get_ylabel())
            assert ax.lines
