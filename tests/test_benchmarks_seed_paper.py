"""Tables compared with the seed paper: exact values, the rule of agreement, and the stored results."""

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm, toeplitz

import B2_seed_paper as script
import quoted
from seed_paper import memory, orthonormal, page, settling, steps
from seed_paper.blocks import REFERENCE, Block, mean_and_spread
from seed_paper.learning import first_below

NUMBERS = json.loads(Path(__file__).with_name("paper_numbers.json").read_text())
RESULTS = Path(script.__file__).parent / "results"


def response(Ts: float, length: int) -> np.ndarray:
    """Impulse response of the deflection from the tabulated state space."""
    A, B = np.array(NUMBERS["A4"]), np.array(NUMBERS["B4"])
    both = expm(Ts * np.block([[A, B[:, None]], [np.zeros((1, 5))]]))
    x, h = both[:4, 4], [0.0]
    for _ in range(length - 1):
        h.append(x[1])
        x = both[:4, :4] @ x
    return np.array(h)


@pytest.mark.parametrize("Ts", [0.02, 0.1])
@pytest.mark.parametrize("cutoff", [None, 5.0])
def test_wiener_error_is_what_least_squares_leaves_of_the_covariance(Ts: float, cutoff: float | None) -> None:
    # Reference: least squares weighted by a root of the covariance.
    h = response(Ts, round(2 / Ts))
    a = np.exp(-2 * np.pi * cutoff * Ts) if cutoff else 0.0
    R = toeplitz(a ** np.arange(len(h)))
    root = np.linalg.cholesky(R).T
    w = np.linalg.lstsq(root[:, :5], root @ h, rcond=None)[0]
    left = root @ h - root[:, :5] @ w
    ours = memory.wiener(memory.impulse_response(Ts), Ts, cutoff)
    assert ours == pytest.approx(left @ left / (h @ R @ h), abs=1e-9)
    name = f"{1e3 * Ts:g} ms"
    given = REFERENCE["2.2"]["NMSE of five delays"][name]["5 Hz" if cutoff else "white"]
    assert ours == pytest.approx(given, abs=1e-4)


def test_plant_poles_make_three_functions_exact() -> None:
    Ts = 0.02
    h = response(Ts, 300)
    poles = orthonormal.plant_poles()
    B = orthonormal.Orthonormal.at(poles, Ts).impulse_responses(len(h))
    assert np.sum((h - B @ (B.T @ h)) ** 2) / np.sum(h**2) < 1e-20
    given = REFERENCE["2.3"]["Coefficients of the deflection on the plant's poles"]["20 ms"]
    np.testing.assert_allclose(orthonormal.coefficients(poles, Ts, h), list(given.values()), atol=1e-6)


def test_exact_tables_agree_with_their_references() -> None:
    for section, part in (("2.6", settling.theory()), ("2.6", steps.mean_bounds()), ("2.6", steps.bounds())):
        compared = part.beside(section)
        assert not compared["unexplained"]
        assert any("reference" in cell for row in compared["rows"].values() for cell in row.values())


def block(value: float | None, **changes: object) -> dict:
    kept = {"absolute": 1e-4, "notes": {}} | changes
    title = "NMSE of five delays"
    return Block(title, "", ("white",), {"100 ms": (value,)}, **kept).beside("2.2")  # type: ignore[arg-type]


def test_a_number_beyond_the_tolerance_is_named_until_it_is_explained() -> None:
    assert not block(0.0006)["beyond"]
    assert block(0.0016)["unexplained"] == ["100 ms | white"]
    assert block(None)["unexplained"] == ["100 ms | white"]
    explained = block(0.0016, notes={"100 ms": "a short record."})
    assert explained["beyond"] == ["100 ms | white"] and not explained["unexplained"]
    text = page.block_text(explained)
    assert "0.0016 (5.40e-04) *" in text and "- 100 ms: a short record." in text
    assert not block(0.0016, spread={"100 ms": (5e-4,)})["beyond"]


def test_spread_is_the_deviation_of_a_record() -> None:
    mean, spread = mean_and_spread([[1.0, None], [3.0, 2.0]])
    assert mean == (2.0, None) and spread == (pytest.approx(np.sqrt(2)), None)


def test_first_time_below_a_level() -> None:
    np.testing.assert_array_equal(
        first_below(np.array([[3.0, 1.0, 2.0], [3.0, 3.0, 3.0]]), 1.5), [20, np.inf]
    )


def test_every_table_has_references_and_a_module() -> None:
    assert list(script.TABLES) == list(REFERENCE)
    for name in script.TABLES.values():
        assert (Path(script.__file__).parent / "seed_paper" / f"{name}.py").exists()


def test_stored_results_are_those_of_the_script() -> None:
    stored = json.loads((RESULTS / "B2.json").read_text())
    assert list(stored["tables"]) == list(script.TABLES)
    for section, table in stored["tables"].items():
        assert not table["quick"]
        titles = {b["title"] for b in table["blocks"]}
        assert set(REFERENCE[section]) <= titles
        assert not any(b["unexplained"] for b in table["blocks"])
    assert (RESULTS / "B2.md").read_text() == quoted.renewed_page(RESULTS / "B2.md", page.page(stored))
