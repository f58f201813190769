"""The public recordings: address, hash, reader, units, and the licence as far as it is known.

Recordings of the package `nonlinear_benchmarks` need no entry:

    train, test = nonlinear_benchmarks.Cascaded_Tanks()
    rf.load(train, outputs="level", units={"level": "V"})
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rotflex_jax.data.readers import (
    load_bam_xl330,
    load_emps,
    load_rotary_arm,
    load_rotflex,
    load_silverbox,
    load_so101,
    load_two_dof_link,
)

ADDRESS = "https://raw.githubusercontent.com/{repository}/{commit}/{path}"


@dataclass(frozen=True)
class PublicFile:
    """A file at a fixed address.

    Args:
        name: path of the file in a local folder of recordings.
        repository: public repository that contains the file.
        commit: version of the repository.
        path: path of the file in the repository.
        sha256: hash of its content.
        companion: whether the reader reads it together with another file of the same run.
    """

    name: str
    repository: str
    commit: str
    path: str
    sha256: str
    companion: bool = False

    @property
    def address(self) -> str:
        """Address from which the file is downloaded."""
        return ADDRESS.format(repository=self.repository, commit=self.commit, path=quote(self.path))


@dataclass(frozen=True)
class PublicDataset:
    """A set of public recordings.

    Args:
        name: name of the data set.
        about: one line on what was measured.
        units: units of the input and the outputs.
        licence: licence, as far as it is known.
        source: authors of the data.
        files: files of the data set.
        reader: function that reads a file to one Recording or to several.
        joint: preset of `rotflex_jax.joints` to begin with, if all recordings are of one machine with a
            preset, and none is reserved for the test of a protocol.
    """

    name: str
    about: str
    units: str
    licence: str
    source: str
    files: tuple[PublicFile, ...]
    reader: Callable[[Path], Any]
    joint: str = ""


def _files(
    folder: str, repository: str, commit: str, there: str, hashes: dict[str, str]
) -> tuple[PublicFile, ...]:
    return tuple(
        PublicFile(f"{folder}/{name}", repository, commit, f"{there}/{name}", sha256)
        for name, sha256 in hashes.items()
    )


_LINK_REPOSITORY = "basta/quanser-2-dof-serial-flexible-link"
_LINK_COMMIT = "48ab0ce6a1b3038e971dec828005c72e90a12e5a"


def _two_dof_link_files() -> tuple[PublicFile, ...]:
    """A run in one file, and a run in six."""
    (whole,) = _files(
        "two_dof_link",
        _LINK_REPOSITORY,
        _LINK_COMMIT,
        "software/quanser_updated",
        {"lqr_full_10deg.mat": "07d75adb0c3e938f9a91653df214acc9e34575f8c1992e8b08249761f6d2ec26"},
    )
    first, *others = _files(
        "two_dof_link",
        _LINK_REPOSITORY,
        _LINK_COMMIT,
        "software/quanser_original/Results",
        {
            "data_fsf_Im1.mat": "2571c01177a84beb218fb9a3690f7df4c9ce0488a37cc6d0ec92b306e4fe9638",
            "data_fsf_Im2.mat": "0fed65953f6b0714c914a812c47e8f9a0fe1ff5f39df9103aaf01476f40c36b0",
            "data_fsf_th11.mat": "deb81153d67653884e208e6c33867118e709df8da1160e007a5ee755fbd6cd92",
            "data_fsf_th12.mat": "efcaeeb2d0816cf920c8be6ee582f3f3d3a793d118e81e98962ed9d54bf0a073",
            "data_fsf_th21.mat": "c1313c875b415090e0fb423a5864655c58398cbc96718399425f69d9918a02e7",
            "data_fsf_th22.mat": "3b59520e7aea5c54a76cb4a48276ef94075360f9b304687b73f7084659bdac36",
        },
    )
    return whole, first, *(replace(file, companion=True) for file in others)


def _so101_files(hashes: dict[str, tuple[str, str]]) -> tuple[PublicFile, ...]:
    """Goals and angles of each motion."""
    return tuple(
        PublicFile(
            f"so101/{motion}.{log}.csv",
            "isaac-sim2real/sage",
            "4ffd2627df9d23e279b35712a67e629ce0c0dfa7",
            f"output/real/so101/custom/{motion}/{log}.csv",
            sha256,
            companion=log == "state_motor",
        )
        for motion, pair in hashes.items()
        for log, sha256 in zip(("control", "state_motor"), pair, strict=True)
    )


DATASETS = {
    dataset.name: dataset
    for dataset in (
        PublicDataset(
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
            joint="quanser_2010",
        ),
        PublicDataset(
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
        PublicDataset(
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
        PublicDataset(
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
        PublicDataset(
            name="two_dof_link",
            about="serial link with two flexible stages, two closed-loop runs of 20 s at 500 Hz",
            units="current [A] to theta, alpha [rad], stage by stage",
            licence="MIT",
            source="aa4cc, Edu Ctrl Lab Models, 2026, and a run of 2011 beside the maker's software",
            files=_two_dof_link_files(),
            reader=load_two_dof_link,
        ),
        PublicDataset(
            name="bam_xl330",
            about="position servo lifting a pendulum, four gains, three motions of 6 s",
            units="goal [rad] to theta [rad]",
            licence="Apache-2.0",
            source="Rhoban, Better Actuator Models, arXiv 2410.08650",
            files=_files(
                "bam_xl330",
                "Rhoban/bam",
                "af2260462471ff45ac18af159b1327ea51d8db15",
                "bam/data.bak/raw",
                {
                    "2026-01-15_10h28m10.json": (
                        "e58f3c2a08a5e0e37a2c5e930d0830a438bc102b8d21482767124f495b92f2ce"
                    ),
                    "2026-01-15_10h28m17.json": (
                        "ef6507934ba465eb31529d7d98715ecc70bd5c87be049fd4618a94ce39290569"
                    ),
                    "2026-01-15_10h28m32.json": (
                        "fdc255edae6995298af437f37582eb8cd0c4a5ddcec4f49fb7c4d6f3303aaa9c"
                    ),
                    "2026-01-15_10h28m42.json": (
                        "1c6386bfa3be021c8ca8a96a7cbee93914f6271a050282b1c3b7d5ef373427db"
                    ),
                    "2026-01-15_10h28m49.json": (
                        "e2223826274fca7799a2be0cb371e4269ead88cd9077fbb68498ef93e4e0de97"
                    ),
                    "2026-01-15_10h29m04.json": (
                        "7996c43314a9f60094a6119346b54ff9ff84cb6726c967f4a88a7175278f6515"
                    ),
                    "2026-01-15_10h29m14.json": (
                        "016d15d21c464457aa30eaeab3977228b08cd5acf7542f24067440126c0bf480"
                    ),
                    "2026-01-15_10h29m21.json": (
                        "fe68cff62e976c87a2fcab925a517fbff83be16c862693310fdc1eff743eddab"
                    ),
                    "2026-01-15_10h29m37.json": (
                        "838d390b7190c4ce1608157cf629989648773b7336728a0931a61c6018c6700b"
                    ),
                    "2026-01-15_10h29m47.json": (
                        "61ae8eeb881be5d8c09f6c7fba4cef39f66b1ff03e0148ef3bc0e314054513f5"
                    ),
                    "2026-01-15_10h29m54.json": (
                        "b50055742ee553a8cb849b38d04d2b9bcf7143d0acefe6539f922984b93d958a"
                    ),
                    "2026-01-15_10h30m10.json": (
                        "01d32db99e7859f012a230aca59f1dda24219d6781472d356861b138526213e6"
                    ),
                },
            ),
            reader=load_bam_xl330,
        ),
        PublicDataset(
            name="so101",
            about="six hobby servos of an SO-101 arm, eight motions at 50 Hz",
            units="goal [rad] to theta [rad], joint by joint; the jaw's are shares of its travel",
            licence="Apache-2.0",
            source="SAGE, Sim2Real Actuator Gap Estimator",
            files=_so101_files(
                {
                    "chirp_sweep": (
                        "9b87d99cdbddfe72cf2f7ceddbde9290b5a47de996fe35f8f2c9a83a84917670",
                        "85e9bd89fbc1cb97d21eba269242aca4437a8faa2116859e96b458b7001579d8",
                    ),
                    "multisine": (
                        "99562591fb0e8cecae236670e14a13458d49a146bb6448c26cdec25935cd5a80",
                        "97d4112d4e83567b62e39e67c1eed515540bbba271a226df5ac796163e35d27b",
                    ),
                    "oscillation_low_freq": (
                        "54e7117a90d43fdc3dc4d1eaff3e22349364f60f9d21e5094537eb13796008e6",
                        "6672b95e2c30d4bbf09738f8f16d9fdc3bf5a726f20dc078683d0f45e6471fdc",
                    ),
                    "prbs_excitation": (
                        "bf4a3a4624842040cb796a0db5a61f47b7de9d8779f53d7825c37e737196ee01",
                        "3900353f0a48a6a2105998f71a29e155c099de9bc0c1b2d44b71402dcc5492d7",
                    ),
                    "single_joint_elbow": (
                        "38f7a57f0db1aa801f1e9e1b0718a1706c90ee90e423d86fb33890fdfd439d95",
                        "500599987ec9878eecbaf767cb9b370172e00eaad00a1c835aa5ee8579a9756f",
                    ),
                    "sinusoidal_sweep": (
                        "bf62f4844175de843a1878c08c281b242a5255b4ad00d9759379826a683b7451",
                        "f498a62d06d435fc0ace8a89238b5a17dab924242d7b8aa78e386ba2706d11cb",
                    ),
                    "staircase_motion": (
                        "459c8da6ce08607e41770028e48addf6ffef9751964baf26e2584da1834f0545",
                        "7f892c2c9e0b38ce938f474739f61b6348f2d1dde4f02c9b520e1440827ca813",
                    ),
                    "step_response": (
                        "ba3ef94713ab9e581c2d587aa88245793ba03c644dd9f455fd869a6b428f3ccc",
                        "74f67c391331664f059c7058f79b42c5845e813c0acf16e7c79851b1b18b9ec5",
                    ),
                }
            ),
            reader=load_so101,
        ),
    )
}


@dataclass(frozen=True)
class ByHand:
    """A public data set that is not downloaded here.

    Args:
        name: name of the data set.
        about: one line on what was measured.
        address: address from which its official loader downloads it.
        loader: function of `nonlinear_benchmarks` that returns it.
        n_init: samples at the start of a test that a model may use, according to the protocol.
    """

    name: str
    about: str
    address: str
    loader: str
    n_init: int | None

    @property
    def advice(self) -> str:
        """How to get the data set."""
        return (
            f"get it from {self.address}, or `pip install nonlinear_benchmarks` and give what "
            f"nonlinear_benchmarks.{self.loader} returns to rf.load"
        )


BY_HAND = {
    entry.name: entry
    for entry in (
        ByHand(
            "ced",
            "coupled electric drives: two motors on a flexible belt, speed without its sign",
            "https://uu.diva-portal.org/smash/get/diva2:1165531/FULLTEXT01.zip",
            "CED()",
            10,
        ),
        ByHand(
            "cascaded_tanks",
            "pump voltage to the level of the lower of two tanks, with overflow",
            "https://data.4tu.nl/file/d4810b78-6cdd-48fe-8950-9bd601e5f47f/3b697e42-01a4-4979-a370-813a456c36f5",
            "Cascaded_Tanks()",
            50,
        ),
        ByHand(
            "wiener_hammerstein",
            "electronic filter, diode, filter",
            "http://www.ee.kth.se/~hjalmars/ifac_tc11_benchmarks/2009_wienerhammerstein/WienerHammerBenchMark.mat",
            "WienerHammerBenchMark()",
            50,
        ),
        ByHand(
            "parallel_wiener_hammerstein",
            "two Wiener-Hammerstein circuits in parallel",
            "https://data.4tu.nl/file/5edca002-b132-4985-b8b9-2353c6e85292/2aaf0790-9ade-43d5-a718-39062524fc93",
            "ParWH()",
            50,
        ),
        ByHand(
            "f16",
            "ground vibration test of an aircraft, clearance and friction at the payloads",
            "https://data.4tu.nl/file/b6dc643b-ecc6-437c-8a8a-1681650ec3fe/5414dfdc-6e8d-4208-be6e-fa553de9866f",
            "F16()",
            50,
        ),
        ByHand(
            "bouc_wen",
            "hysteretic oscillator, simulated",
            "https://data.4tu.nl/file/7060f9bc-8289-411e-8d32-57bef2740d32/cd40469c-5064-4968-ae59-88cbb850264b",
            "not_splitted_benchmarks.BoucWen()",
            None,
        ),
        ByHand(
            "industrial_robot",
            "six joints of a robot with backlash and friction",
            "https://fdm-fallback.uni-kl.de/TUK/FB/MV/WSKL/0001/Robot_Identification_Benchmark_Without_Raw_Data.rar",
            "not_splitted_benchmarks.Industrial_robot()",
            None,
        ),
    )
}
