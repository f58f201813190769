"""Public benchmarks that are fetched by hand: their files come in archives, or their hash is not known here.

import nonlinear_benchmarks
train, test = nonlinear_benchmarks.Cascaded_Tanks()
rf.load(train, outputs="level", units={"level": "V"})
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class ByHand:
    """A public data set that is not downloaded here.

    Args:
        name: to know it by.
        about: one line on what was measured.
        address: where its official loader takes it from.
        loader: what gives it in `nonlinear_benchmarks`.
        n_init: samples at the start of a test that a model may look at, by its protocol.
    """

    name: str
    about: str
    address: str
    loader: str
    n_init: int | None

    @property
    def advice(self) -> str:
        """What to do to have it."""
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
