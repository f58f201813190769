"""Settings of the reproduced experiment, and the simulated machine with the source of each parameter.

The paper gives the memory, the variance of the input, the pulse and a table of constants. It gives no
sampling interval, filter, step sizes or number of samples, no friction or dead zone, no sign convention, and
no error as a number. All inputs that it does not give are settings here.
"""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, Literal

from rotflex_jax.effects import Saturation
from rotflex_jax.errors import InputError
from rotflex_jax.mechanism import Mechanism
from rotflex_jax.reproduce.plants import SCENARIOS, plant

PAPER, ASSUMPTION, NUMERICS = "paper", "assumption", "numerics"
TINY = 1e-12  # lower limit of a setting that must be positive


def setting(
    default: Any,
    source: str,
    why: str,
    *,
    unit: str = "",
    choices: tuple[Any, ...] = (),
    least: float = -math.inf,
    most: float = math.inf,
) -> Any:
    """A field of the settings.

    Args:
        default: Default value; its type is the type of the setting.
        source: Source of the default: `PAPER`, `ASSUMPTION` or `NUMERICS`.
        why: Reason for the default, in words.
        unit: Unit of a number.
        choices: All valid values; empty for a number.
        least: Smallest valid number; `TINY` for any number above zero.
        most: Largest valid number.
    """
    about = {"source": source, "why": why, "unit": unit, "choices": choices, "least": least, "most": most}
    return dataclasses.field(default=default, metadata=about)


def checked(field: dataclasses.Field, value: Any) -> Any:
    """The value, converted to the type of the setting.

    Raises:
        InputError: The value is not valid; the message gives the valid range or choices.
    """
    about, unit = field.metadata, field.metadata["unit"]
    default: Any = field.default
    if about["choices"]:
        if value not in about["choices"]:
            choices = ", ".join(map(str, about["choices"]))
            raise InputError(
                f"Setting {field.name} was given {value!r}, but is one of {choices}; choose one."
            )
        return value
    if isinstance(default, tuple):
        return value  # checked by `_consistent`, since it depends on other settings
    try:
        number = type(default)(value)
        right = math.isfinite(number) and number == value
    except (TypeError, ValueError, OverflowError):
        right, number = False, 0
    if not right or not about["least"] <= number <= about["most"]:
        kind = "a whole number" if isinstance(default, int) else "a number"
        raise InputError(
            f"Setting {field.name} was given {value!r}, but it needs {kind}{_bounds(about)}"
            f"{f' in {unit}' if unit else ''}; give for instance {default:g}."
        )
    return number


def _bounds(about: Mapping[str, Any]) -> str:
    least, most = about["least"], about["most"]
    low = "" if least == -math.inf else " above 0" if least == TINY else f" of at least {least:g}"
    return low + ("" if most == math.inf else f" and at most {most:g}")


def read(field: dataclasses.Field, value: Any) -> Any:
    """Text converted to the value of a setting; invalid text is unchanged, so that `checked` refuses it."""
    if not isinstance(value, str):
        return value
    try:
        if field.name == "coefficient":
            return tuple(int(part) for part in value.replace("(", "").replace(")", "").split(","))
        if isinstance(field.default, bool):
            return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}[
                value.lower()
            ]
        if isinstance(field.default, int | float):
            number = float(value)
            return int(number) if isinstance(field.default, int) and number == int(number) else number
    except (KeyError, ValueError, OverflowError):
        return value
    return value


FILTERS = ("ar1", "butterworth", "fir")
TRANSFORMS = ("none", "hermite", "gram_schmidt")


@dataclasses.dataclass(frozen=True)
class Settings:
    """Settings of one run of the paper's experiment.

    Raises:
        InputError: A value has the wrong type, is out of range, or is none of the choices.

    >>> Settings().memory, Settings(Ts=0.05).Ts
    (5, 0.05)
    """

    # The machine.
    scenario: str = setting(
        "S6",
        ASSUMPTION,
        "symmetric friction and dead zone alone leave every quadratic coefficient at zero, so nothing "
        "could converge; an amplifier offset of 0.3 V gives them something to find",
        choices=tuple(SCENARIOS),
    )
    arm_friction: str = setting(
        "joint",
        ASSUMPTION,
        "friction between hub and arm; 'the rotational speeds of the two rotating masses' may also "
        "mean against the table",
        choices=("joint", "arm"),
    )
    plant: tuple[tuple[str, float], ...] = setting(
        (),
        ASSUMPTION,
        "other parameters of the machine by their full names, such as hub.coulomb.level=0.05; no friction or "
        "dead zone of this module has been published",
    )
    efficiency: float = setting(
        1.0, ASSUMPTION, "of motor and gear; the paper lists none, the maker 0.62", least=TINY, most=1.0
    )
    inductance: float = setting(
        0.0,
        ASSUMPTION,
        "the listed 0.18 mH acts within 0.1 ms and changes the deflection by 2e-6 (NMSE); 0 for none",
        unit="H",
        least=0.0,
    )
    saturation: float = setting(5.0, PAPER, "largest voltage of its table", unit="V", least=TINY)
    sign: int = setting(
        1,
        ASSUMPTION,
        "1: a positive voltage leaves the arm behind, so that the first deflection is negative",
        choices=(1, -1),
    )
    sensor_noise: float = setting(
        0.0,
        ASSUMPTION,
        "standard deviation; an ideal sensor shows the method's own errors",
        unit="rad",
        least=0,
    )

    # The recording.
    Ts: float = setting(
        0.1,
        ASSUMPTION,
        "sampling interval; five samples hold the 0.4 s that the joint remembers only from 0.08 s on",
        unit="s",
        least=TINY,
    )
    filter: str = setting("ar1", ASSUMPTION, "the simplest filter that makes coloured noise", choices=FILTERS)
    cutoff: float = setting(
        5.0,
        ASSUMPTION,
        "of the filter; convergence in 7000 iterations needs samples that are nearly white",
        unit="Hz",
        least=TINY,
    )
    variance: float = setting(1.0, PAPER, "of the input, section 5", unit="V²", least=TINY)
    samples: int = setting(14000, ASSUMPTION, "twice the 7000 iterations, so that rest shows", least=200)
    held_out: int = setting(10000, ASSUMPTION, "samples that no model learns from", least=200)
    seed: int = setting(1, ASSUMPTION, "of the random numbers", least=0)

    # The model and its adaptation.
    memory: int = setting(5, PAPER, "M of section 5", least=2, most=10)
    layout: Literal["triangular", "full"] = setting(
        "triangular",
        ASSUMPTION,
        "each product once; (13) may also mean twice ('full'), which doubles step sizes off the diagonal",
        choices=("triangular", "full"),
    )
    constant: bool = setting(
        True,
        PAPER,
        "h0 of (10); (13) and (14) drop it, which biases the quadratic kernel",
        choices=(True, False),
    )
    transform: str = setting(
        "none",
        ASSUMPTION,
        "(15) to (17) update the raw kernels; the orthogonalisation that the paper mentions is not shown",
        choices=TRANSFORMS,
    )
    settle_at: float = setting(
        7000.0, PAPER, "iterations after which the coefficient of Fig. 9 rests", unit="iterations", least=10
    )
    coefficient: tuple[int, int] = setting(
        (1, 1),
        ASSUMPTION,
        "lags of the quadratic coefficient in Fig. 9; lag 0 cannot act yet, so this is the first that can",
    )
    mu1: float = setting(
        0.01, ASSUMPTION, "step size of h0 and the linear kernel: 3 % excess error", unit="1/V²", least=TINY
    )
    mu2: float = setting(
        0.0,
        ASSUMPTION,
        "step size of the quadratic kernel; 0: predicted from settle_at",
        unit="1/V⁴",
        least=0.0,
    )
    runs: int = setting(
        8,
        NUMERICS,
        "repetitions with other inputs, to tell the mean of Fig. 9 from its noise",
        least=1,
        most=64,
    )

    # The pulse.
    pulse: float = setting(2.0, PAPER, "height, section 5", unit="V")
    pulse_width: float = setting(1.0, PAPER, "section 5", unit="s", least=TINY)
    pulse_delay: float = setting(0.5, NUMERICS, "rest before it", unit="s", least=0.0)
    pulse_after: float = setting(1.5, NUMERICS, "watched after it", unit="s", least=0.0)

    grey_box: bool = setting(
        False,
        NUMERICS,
        "whether to fit the joint's equations with friction too; takes a minute",
        choices=(True, False),
    )
    step: float = setting(
        1e-3, NUMERICS, "longest step of the simulator; errs by less than 1e-9 (NMSE)", unit="s", least=1e-6
    )

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = checked(field, getattr(self, field.name))
            object.__setattr__(self, field.name, value)
        _consistent(self)

    def replace(self, changes: Mapping[str, Any]) -> "Settings":
        """The settings with some values changed; text is converted to the type of the setting.

        A name with dots is the name of a parameter of the machine and belongs to `plant`.

        >>> Settings().replace({"memory": "8", "coefficient": "1,2"}).coefficient
        (1, 2)
        """
        fields = {field.name: field for field in dataclasses.fields(self)}
        parameters = {name: value for name, value in changes.items() if "." in name}
        changes = {name: value for name, value in changes.items() if name not in parameters}
        if parameters:
            changes["plant"] = tuple((dict(self.plant) | parameters).items())
        for name in changes:
            if name not in fields:
                raise InputError(
                    f"{name!r} is no setting of the experiment, which has {', '.join(fields)}; "
                    "choose one of these."
                )
        values = {name: read(fields[name], value) for name, value in changes.items()}
        return dataclasses.replace(self, **values)

    @classmethod
    def table(cls) -> list[dict[str, Any]]:
        """All settings with default, unit, source ("paper", "assumption", "numerics") and reason."""
        return [
            {
                "name": field.name,
                "default": field.default,
                **{key: field.metadata[key] for key in ("unit", "source", "why", "choices")},
            }
            for field in dataclasses.fields(cls)
        ]

    def rows(self) -> list[dict[str, Any]]:
        """`table` with the values of this run and whether they were changed."""
        return [
            row
            | {"value": getattr(self, row["name"]), "changed": getattr(self, row["name"]) != row["default"]}
            for row in self.table()
        ]


def _consistent(s: Settings) -> None:
    """Checks settings that depend on each other, and brings `coefficient` and `plant` into standard form."""
    lags = s.coefficient
    if not (
        isinstance(lags, tuple | list)
        and len(lags) == 2
        and all(isinstance(lag, int) and 0 <= lag < s.memory for lag in lags)
    ):
        raise InputError(
            f"Setting coefficient was given {lags!r}, but it needs two lags from 0 to {s.memory - 1}, the "
            "memory less one; give for instance 1,1."
        )
    object.__setattr__(s, "coefficient", tuple(sorted(lags)))
    object.__setattr__(s, "plant", tuple((name, _number(name, value)) for name, value in s.plant))
    if not s.cutoff < 0.5 / s.Ts and s.filter == "butterworth":
        raise InputError(
            f"Setting cutoff was given {s.cutoff:g} Hz, but a Butterworth filter needs one below half the "
            f"sampling rate, {0.5 / s.Ts:g} Hz; lower it, or take the filter ar1."
        )
    if round(s.pulse_width / s.Ts) < 1:
        raise InputError(
            f"Setting pulse_width was given {s.pulse_width:g} s, but a pulse lasts at least one sample of "
            f"{s.Ts:g} s; lengthen it or shorten Ts."
        )


def _number(name: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        raise InputError(f"{name} was given {value!r}, but it needs a number; give one.") from None


SYMMETRIC_SCENARIO = "S1"

ASSUMED_BECAUSE = {
    "hub.motor.back_emf": "taken equal to the torque constant, as in SI units it is; the paper lists one",
    "hub.viscous.coefficient": "none beside the motor's own; the paper lists none",
    "joint.viscous.coefficient": "none; the paper lists none",
}


def linear_joint(s: Settings) -> Mechanism:
    """The paper's linear joint, with the constants that the paper lists."""
    return plant("S0", efficiency=s.efficiency, inductance=s.inductance or None)


def machine(s: Settings) -> Mechanism:
    """The joint of the scenario with an amplifier that saturates, and with the parameters in `s.plant`.

    Raises:
        InputError: A parameter is unknown or out of its range.
    """
    return _scenario(s).with_values(dict(s.plant))


def symmetric_twin(s: Settings) -> Mechanism:
    """The machine with symmetric friction and dead zone (scenario S1) instead of the scenario's effects."""
    twin = _scenario(dataclasses.replace(s, scenario=SYMMETRIC_SCENARIO))
    known = {name: value for name, value in s.plant if name in twin.parameter_names}
    return twin.with_values(known)


def machine_rows(s: Settings) -> list[dict[str, Any]]:
    """Parameters of the machine as rows of the table of settings, with the paper or an assumption as source.

    >>> [row["name"] for row in machine_rows(Settings()) if row["source"] == "paper"][:2]
    ['hub.inertia.inertia', 'arm.inertia.inertia']
    """
    before, after = _scenario(s), machine(s)
    listed = linear_joint(s).named_values
    settings_of_their_own = {"hub.motor.efficiency", "hub.motor.inductance", "input.saturation.limit"}
    rows = []
    for name, spec, default, value in zip(
        after.parameter_names, after.parameter_specifications, before.values, after.values, strict=True
    ):
        if name in settings_of_their_own:
            continue
        paper = listed.get(name) == default and name not in ASSUMED_BECAUSE
        rows.append(
            {
                "name": name,
                "default": float(default),
                "unit": spec.unit,
                "source": PAPER if paper else ASSUMPTION,
                "why": "its table"
                if paper
                else ASSUMED_BECAUSE.get(name, f"{spec.meaning}; scenario {s.scenario}"),
                "choices": (),
                "value": float(value),
                "changed": bool(value != default),
            }
        )
    return rows


def _scenario(s: Settings) -> Mechanism:
    parameters = {"efficiency": s.efficiency, "inductance": s.inductance or None}
    return plant(s.scenario, s.arm_friction, **parameters) + Saturation(limit=s.saturation)
