"""The public recordings: address, hash, reader, units and what is known of the licence."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rotflex_jax.data.readers import load_emps, load_rotary_arm, load_silverbox
from rotflex_jax.data.rotflex import load_rotflex

ADDRESS = "https://raw.githubusercontent.com/{repository}/{commit}/{path}"


@dataclass(frozen=True)
class PublicFile:
    """A file at a fixed address.

    Args:
        name: its path in a local folder of recordings.
        repository: public repository it is kept in.
        commit: version of the repository.
        path: its path there.
        sha256: hash of its content.
    """

    name: str
    repository: str
    commit: str
    path: str
    sha256: str

    @property
    def address(self) -> str:
        """Where it is downloaded from."""
        return ADDRESS.format(repository=self.repository, commit=self.commit, path=quote(self.path))


@dataclass(frozen=True)
class Dataset:
    """A set of public recordings.

    Args:
        name: to ask for it by.
        about: one line on what was measured.
        units: of the input and the outputs.
        licence: what is known of it.
        source: who made it.
        files: where they are.
        reader: file to Recording, or to several.
    """

    name: str
    about: str
    units: str
    licence: str
    source: str
    files: tuple[PublicFile, ...]
    reader: Callable[[Path], Any]


def _files(
    folder: str, repository: str, commit: str, there: str, hashes: dict[str, str]
) -> tuple[PublicFile, ...]:
    return tuple(
        PublicFile(f"{folder}/{name}", repository, commit, f"{there}/{name}", sha256)
        for name, sha256 in hashes.items()
    )


DATASETS = {
    dataset.name: dataset
    for dataset in (
        Dataset(
            name="rotflex",
            about="SRV02 with rotary flexible joint, two closed-loop runs of 10 s at 500 Hz",
            units="voltage [V] to theta, alpha [rad]",
            licence="none stated",
            source="student laboratory MREN 348, laboratory 4, 2025",
            files=_files(
                "rotflex",
                "theOneAndOnlyOne/MREN348Labs",
                "c83f7dd7fd718625b863fa37bc18bdbd42ec5741",
                "Lab4",
                {
                    "PDControllerA.mat": ("5d6650cb7f19bdbeac7e8e22ee0c7eb23fe3ca4052206db089867d923a240618"),
                    "PDControllerB.mat": ("5082ba05204282835ab09e9fcc2e1d1ac4fb309626df2ea4b9b36fef10816034"),
                },
            ),
            reader=load_rotflex,
        ),
        Dataset(
            name="emps",
            about="Electro-Mechanical Positioning System, to learn from and with force pulses",
            units="voltage [V] to position [m]",
            licence="none stated",
            source="Janot, Gautier, Brunot 2019, nonlinearbenchmark.org",
            files=_files(
                "emps",
                "forgi86/sysid-neural-continuous",
                "956aa7ecd73061b0321c6f6098d74c9e4a7ce67a",
                "examples/EMPS/data",
                {
                    "DATA_EMPS.mat": ("6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e"),
                    "DATA_EMPS_PULSES.mat": (
                        "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704"
                    ),
                },
            ),
            reader=load_emps,
        ),
        Dataset(
            name="silverbox",
            about="electronic oscillator with a cubic spring, in its four official parts",
            units="voltage [V] to output [V]",
            licence="none stated",
            source="Wigren, Schoukens 2013, nonlinearbenchmark.org",
            files=_files(
                "silverbox",
                "biaslab/nsi-silverbox",
                "728f07e4539d4f7da76a4778b52a756260b488ac",
                "data/Silverbox",
                {"SNLS80mV.mat": ("5c7413a52255af0cb4e2f93fb6903beb92b08965ba1e6ad0a6ffedfed8477ed4")},
            ),
            reader=load_silverbox,
        ),
        Dataset(
            name="rotary_arm",
            about="geared motor with a flexible (first) or a rigid arm, four runs at 1 kHz",
            units="voltage [V] to theta, with the flexible arm also alpha [rad]",
            licence="none stated",
            source="student laboratory ASEN 2003, laboratory 6, 2017",
            files=_files(
                "rotary_arm",
                "BenHagenau/ASEN2003",
                "3f455292387be8bbcfbeaebeceec5cd6bb74021a",
                "Lab 6: Rotary Arm",
                {
                    "flexarm_K1_6": ("8ca16bf31c8b422888a2cbec0c96b6f50bd96201802b88bf212269246a0b4a89"),
                    "rigidarm_K1_6": ("cef3913bd8839f215918dee1bbcca5d9e600b0d66ed60a0876f4f5912582fb30"),
                    "rigidarm_K1_8": ("60afa85806050e34d36f12da5ba6c5de071b8ece0d520ec73a42c286e100cc96"),
                    "rigidarm_k1k3_6": ("ce1387528cc4e3fd9f081c566489ea3ea9cfee2c03fe10ec70a1070fead2428a"),
                },
            ),
            reader=load_rotary_arm,
        ),
    )
}
