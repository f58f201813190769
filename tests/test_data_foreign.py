"""Recordings as objects of other libraries, and public datasets that are downloaded by hand."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.cli.app import main
from rotflex_jax.data.datasets import DATASETS, fetch
from rotflex_jax.data.foreign import is_foreign
from rotflex_jax.data.registry import BY_HAND
from rotflex_jax.errors import InputError

K = np.arange(300.0)


def run(**parts):
    given = {"u": np.sin(K), "y": np.cos(0.1 * K), "sampling_time": 0.01, "name": "train"}
    return SimpleNamespace(**given | parts)


def test_the_objects_of_nonlinear_benchmarks():
    kind = pytest.importorskip("nonlinear_benchmarks.utilities").Input_output_data
    held = kind(
        u=np.sin(K), y=np.cos(0.1 * K), sampling_time=0.01, name="test", state_initialization_window_length=20
    )
    for source in (held, held.atleast_2d()):
        recording = rf.load(source, outputs="position", units={"position": "m"})
        assert (recording.channels, recording.units) == (("position",), ("m",))
        assert (recording.Ts, recording.n_init, recording.source) == (0.01, 20, "test")
        np.testing.assert_array_equal(recording.y[:, 0], held.y)
    # A slice of such an object loses its name and its initialisation length.
    assert rf.load(held[:100]).N == 100


def test_any_object_with_input_and_outputs():
    two = rf.load(run(y=np.stack([np.cos(K), np.sin(0.2 * K)], axis=1)), Ts=0.02)
    assert (two.channels, two.units, two.Ts) == (("output_1", "output_2"), ("", ""), 0.02)
    assert rf.load(run(), outputs={"theta": "y"}, units={"theta": "rad"}).channels == ("theta",)
    with pytest.raises(InputError, match="train has no sampling_time"):
        rf.load(run(sampling_time=None))
    with pytest.raises(InputError, match="must name columns of a file or a table"):
        rf.load(run(), signals="base")
    with pytest.raises(InputError, match="is nan at sample 0"):
        rf.load(run(y=np.full(300, np.nan)))


@pytest.mark.parametrize(
    "option",
    [
        {"degrees": True},
        {"counts": 4096},
        {"input": "volts"},
        {"time": "t"},
        {"time_unit": "ms"},
        {"resample": 0.02},
        {"arm_absolute": True},
    ],
)
def test_options_on_columns_are_refused(option):
    with pytest.raises(InputError, match=f"`{next(iter(option))}` says how to read a file or a table"):
        rf.load(run(), outputs="theta", units={"theta": "rad"}, **option)


def test_unit_of_no_channel_is_refused():
    with pytest.raises(InputError, match="train: argument `units` names 'thet', but the channels are theta"):
        rf.load(run(), outputs="theta", units={"thet": "rad"})


def test_a_table_is_no_foreign_recording():
    pd = pytest.importorskip("pandas")
    frame = pd.DataFrame({"t": K / 100, "u": np.sin(K), "y": np.cos(0.1 * K)})
    assert not is_foreign(frame)
    assert not is_foreign({"u": K, "y": K})
    assert rf.load(frame, input="u", outputs={"position": "y"}).channels == ("position",)


def test_what_is_fetched_by_hand_says_how(capsys: pytest.CaptureFixture[str]):
    assert not set(BY_HAND) & set(DATASETS)
    for entry in BY_HAND.values():
        assert entry.address.startswith("http") and " " not in entry.address
        with pytest.raises(InputError, match="is not downloaded here; get it from http"):
            fetch(entry.name)


def test_loaders_by_hand_exist():
    loaders: ModuleType = pytest.importorskip("nonlinear_benchmarks")
    pytest.importorskip("nonlinear_benchmarks.not_splitted_benchmarks")
    for entry in BY_HAND.values():
        found = loaders
        for part in entry.loader.removesuffix("()").split("."):
            found = getattr(found, part)
        assert callable(found)


def test_the_command_lists_both(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["rotflex", "data", "list"])
    with pytest.raises(SystemExit) as ended:
        main()
    shown = capsys.readouterr().out
    assert ended.value.code == 0
    assert all(name in shown for name in (*DATASETS, *BY_HAND))
