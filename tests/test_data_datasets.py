"""Public recordings: the registry, the hash that is always checked, and the readers."""

import re
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path

import numpy as np
import pooch
import pytest
import scipy.io

from rotflex_jax.data import demo_recording, load, load_rotflex, save_csv
from rotflex_jax.data.datasets import DATASETS, fetch, list_datasets, load_dataset
from rotflex_jax.data.readers import COUNT, LABORATORY
from rotflex_jax.data.registry import PublicDataset, PublicFile
from rotflex_jax.errors import InputError
from rotflex_jax.recording import Recording

Measured = Callable[[str], list[Recording]]


def test_every_entry_says_where_it_is_what_it_is_and_whose() -> None:
    assert {"rotflex", "emps", "silverbox", "rotary_arm", "two_dof_link", "bam_xl330", "so101"} == set(
        DATASETS
    )
    for dataset in list_datasets():
        assert dataset.about
        assert dataset.units
        assert dataset.licence
        assert dataset.source
        for file in dataset.files:
            assert re.fullmatch("[0-9a-f]{64}", file.sha256)
            assert re.fullmatch("[0-9a-f]{40}", file.commit)
            assert file.commit in file.address
            assert file.address.startswith("https://")
            assert " " not in file.address
    hashes = [file.sha256 for dataset in list_datasets() for file in dataset.files]
    assert len(set(hashes)) == len(hashes)


def test_unknown_name_is_answered_with_the_known_ones() -> None:
    with pytest.raises(InputError, match=r"no data set 'robot'; choose one of rotflex, emps"):
        fetch("robot")


def test_folder_without_the_file_is_no_reason_to_download(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist, though the folder was given"):
        fetch("rotflex", tmp_path)


def test_folder_from_the_environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROTFLEX_DATA", str(tmp_path))
    with pytest.raises(InputError, match=re.escape(str(tmp_path))):
        fetch("rotflex")


def test_file_with_another_hash_is_refused(tmp_path: Path) -> None:
    for file in DATASETS["rotflex"].files:
        (tmp_path / file.name).parent.mkdir(exist_ok=True)
        (tmp_path / file.name).write_bytes(b"not the original")
    with pytest.raises(InputError, match="SHA-256"):
        fetch("rotflex", tmp_path)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache, and no folder in its place."""
    monkeypatch.delenv("ROTFLEX_DATA", raising=False)
    monkeypatch.setattr(pooch, "os_cache", lambda name: tmp_path / name)
    return tmp_path


def serve(monkeypatch: pytest.MonkeyPatch, content: Callable[[str], bytes]) -> list[str]:
    """Replace the download in pooch, but not its cache and hash check; the requested URLs are returned."""
    asked: list[str] = []

    def downloader(url: str, output_file: str, pooch: object) -> None:
        asked.append(url)
        Path(output_file).write_bytes(content(url))

    monkeypatch.setattr("pooch.core.choose_downloader", lambda url, progressbar=False: downloader)
    return asked


def test_download_with_another_hash_is_refused(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    serve(monkeypatch, lambda url: b"moved")
    with pytest.raises(InputError, match="no longer the public file"):
        fetch("emps")
    assert not list(cache.rglob("*.mat"))


def test_no_network_is_said_in_a_sentence(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unreachable(url: str) -> bytes:
        raise ConnectionError(url)

    serve(monkeypatch, unreachable)
    with pytest.raises(InputError, match=r"could not be downloaded .* check the network"):
        fetch("silverbox")


def test_download_happens_once(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_csv(demo_recording(), cache / "original.csv")
    content = (cache / "original.csv").read_bytes()
    file = PublicFile("own/run 1.csv", "a/b", "0" * 40, "d/run 1.csv", sha256(content).hexdigest())
    own = PublicDataset("own", "a run", "V to rad", "MIT", "this test", (file,), load)
    monkeypatch.setitem(DATASETS, "own", own)
    asked = serve(monkeypatch, lambda url: content)
    paths = fetch("own") + fetch("own")
    assert asked == [f"https://raw.githubusercontent.com/a/b/{'0' * 40}/d/run%201.csv"]
    assert [path.read_bytes() for path in paths] == [content, content]
    assert cache in paths[0].parents
    np.testing.assert_array_equal(load_dataset("own")[0].y, demo_recording().y)


def test_rotflex_is_the_joint_in_radians(measured: Measured) -> None:
    first, second = measured("rotflex")
    for recording, path in zip((first, second), fetch("rotflex"), strict=True):
        assert (recording.N, recording.Ts, recording.start) == (5001, 0.002, 0.0)
        assert recording.channels == ("theta", "alpha")
        assert recording.resolution == {"theta": COUNT, "alpha": COUNT}
        counts = recording.y / COUNT
        np.testing.assert_allclose(counts, np.round(counts), atol=1e-6)
        by_columns = load(
            path,
            time="data_vm[0]",
            input="data_vm[1]",
            outputs=("data_theta[2]", "data_alpha[1]"),
            degrees=True,
        )
        np.testing.assert_allclose(by_columns.y, recording.y, atol=1e-15)
        np.testing.assert_array_equal(by_columns.u, recording.u)
    # Largest angle of the first run, largest voltage of the second.
    assert np.rad2deg(first.y[:, 0].max()) == pytest.approx(29.18, abs=0.01)
    assert np.max(np.abs(second.u)) == pytest.approx(5.009, abs=0.001)


def test_laboratory_parameters_are_those_in_the_file(measured: Measured) -> None:
    measured("rotflex")
    names = {"R_m": "Rm", "k_t": "kt", "k_m": "km", "K_g": "Kg", "eta_g": "eta_g"}
    names |= {"eta_m": "eta_m", "B_hub": "Beq", "J_hub": "Jeq", "J_arm": "Jl", "K": "K_Stiff"}
    stored = scipy.io.loadmat(fetch("rotflex")[0])
    assert set(names) == set(LABORATORY)
    for name, (value, unit) in LABORATORY.items():
        assert value == pytest.approx(stored[names[name]].item(), rel=2e-3)
        assert unit


def test_other_file_is_not_taken_for_a_rotflex_run(tmp_path: Path) -> None:
    scipy.io.savemat(tmp_path / "run.mat", {"data_vm": np.ones((9, 2))})
    with pytest.raises(InputError, match="lacks data_alpha, data_theta"):
        load_rotflex(tmp_path / "run.mat")


def test_emps_and_silverbox_follow_their_protocols(measured: Measured) -> None:
    train, test = measured("emps")
    assert (train.N, test.N, train.n_init) == (24841, 24841, 20)
    assert train.Ts == pytest.approx(1e-3, rel=1e-4)
    assert (train.channels, train.units) == (("position",), ("m",))
    multisine, held_out, arrow, shorter = measured("silverbox")
    assert (multisine.N, held_out.N, arrow.N, shorter.N) == (65062, 21688, 40475, 32000)
    assert multisine.n_init == held_out.n_init == 50
    assert 1 / arrow.Ts == pytest.approx(610.35)
    assert "held out" in held_out.source


def test_rotary_arm_is_in_seconds_and_radians(measured: Measured) -> None:
    flexible, *rigid = measured("rotary_arm")
    assert flexible.channels == ("theta", "alpha")
    assert np.max(np.abs(flexible.y[:, 1])) < 1.0
    # The arm lags behind the hub when a step of the voltage sets the hub in motion.
    steps = np.flatnonzero(np.abs(np.diff(flexible.u)) > 0.5)
    assert len(steps) == 2
    for k in steps:
        hub, lag = flexible.y[k + 80] - flexible.y[k]
        assert hub * lag < 0
    assert all(recording.channels == ("theta",) for recording in rigid)
    assert all((recording.Ts, recording.N) == (0.001, 10000) for recording in rigid)


def test_demo_comes_with_the_package() -> None:
    recording = demo_recording()
    assert recording.channels == ("theta", "alpha")
    assert {finding.severity for finding in recording.findings} == {"note"}
