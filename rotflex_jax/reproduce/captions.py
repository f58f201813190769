"""What each figure shows and what is assumed in it, in words."""

from rotflex_jax.reproduce.experiment import Reproduction
from rotflex_jax.reproduce.plants import SCENARIOS
from rotflex_jax.reproduce.runs import orthonormal_row

FILTER_WORDS = {
    "ar1": "first-order",
    "butterworth": "fourth-order Butterworth",
    "fir": "finite-impulse-response",
}


def captions(result: Reproduction) -> dict[str, tuple[str, str]]:
    """Figure name -> caption and a description for those who cannot see it."""
    s = result.settings
    pulse = bool(result.records.pulses)
    where = "on the pulse" if pulse else "in free run on held-out data"
    return {
        "figure_07": (
            f"Figure 7. The input. {_input(result)}",
            "Input voltage over time and its autocovariance.",
        ),
        "figure_08": (f"Figure 8. The output. {_machine(result)}", "Output of the machine over time."),
        "figure_09": (
            f"Figure 9. {_coefficient(result)}",
            "A quadratic coefficient over the iterations of LMS.",
        ),
        "figure_10": (
            f"Figure 10. The paper's model, weights frozen, {where}, beside linear models identified from "
            f"the same data. {_plateau(result) if pulse else _no_pulse()}",
            f"Output of the quadratic model and of identified linear models {where}.",
        ),
        "figure_11": (
            f"Figure 11. The linearised joint {where}, beside a linear model that was identified. What an "
            "identified quadratic model gains over the linearised one is mostly the gain of "
            "identification: the linear one has it too.",
            f"Output of the linearised joint and of an identified linear model {where}.",
        ),
        "span": (
            f"What a memory of {s.memory} samples can hold. The joint remembers its input for about 0.4 s, "
            "so the sampling interval decides; no algorithm comes below these lines on a linear joint. "
            "Computed from the linear model alone, nothing is fitted.",
            "Least error of a linear model over the sampling interval.",
        ),
        "kernels": (
            "The kernels of the quadratic model, once by differentiating the equations of the simulated "
            "machine and averaging over its input, once by least squares from the data. Where they agree, "
            "a kernel can be read: the table below says which effect makes which part of it.",
            "First and second kernel of the equations and of the data, and their difference.",
        ),
        "trap": (
            "What the online error hides. Symmetric friction (S1), a sampling interval at which the memory "
            "is far too short, input below the same corner. The filter follows the slow part of the output "
            "with its weights, which makes its own error small and its weights worthless.",
            "Bars of the online error, of the frozen weights and of least squares.",
        ),
    }


def _input(result: Reproduction) -> str:
    s, first = result.settings, result.records.train[0]
    if result.records.measured:
        many = f", thinned out into {result.records.phases} records" if result.records.phases > 1 else ""
        return (
            f"Recorded{many}; each value is the mean of the voltage over {first.Ts:g} s. It was not "
            "designed for identification: its variance, its band and whether a controller made it are "
            "what they are."
        )
    return (
        f"Gaussian noise of variance {s.variance:g} V² through a {FILTER_WORDS[s.filter]} filter. Assumed: "
        f"the filter and its corner of {s.cutoff:g} Hz, the sampling interval of {s.Ts:g} s, {s.samples} "
        "samples."
    )


def _machine(result: Reproduction) -> str:
    s = result.settings
    if result.records.measured:
        names = ", ".join(dict.fromkeys(r.source for r in result.records.train if r.source))
        return f"Measured{f' ({names})' if names else ''}, every {result.records.Ts:g} s."
    first = "negative" if s.sign > 0 else "positive"
    return (
        f"Simulated, {s.scenario}: {SCENARIOS[s.scenario].about}. All of these are assumptions, as is the "
        f"sign: a positive voltage gives a {first} first deflection. The paper's figure has no axis."
    )


def _coefficient(result: Reproduction) -> str:
    a, s = result.adaptation, result.settings
    text = (
        f"The quadratic coefficient at the lags {s.coefficient[0]} and {s.coefficient[1]}. Its step size, "
        f"{a.prediction.step_sizes[2]:.3g}, was chosen before the run so that the mean comes 95 % of its "
        f"way in {a.prediction.settle:.0f} iterations (ln 20 / (7000 × eigenvalue "
        f"{a.prediction.eigenvalue:.3g})); "
    )
    if s.mu2:
        text = text.replace(
            "was chosen before the run so that the mean comes", "was given; the mean should come"
        )
        text = text.replace(" (ln 20 / (7000 ×", " (ln 20 / (step size ×")
    text += (
        f"measured: {a.settle:.0f}. " if a.settle is not None else "measured: it does not settle on a value. "
    )
    if a.status != "ok":
        text += f"The filter {a.status}. "
    if a.passes > 1:
        text += f"The recordings are too short for that, so they were gone through {a.passes} times. "
    if a.symmetric is not None:
        text += (
            "Right: the same input to a machine whose friction and dead zone are symmetric. It answers a "
            "voltage turned round with its motion turned round, and a quadratic kernel cannot do that: "
            "the coefficient is zero, and what looks like convergence is the noise of the algorithm. "
        )
    machine = "" if result.records.measured else ", filter"
    return f"{text}Assumed: step sizes, sampling interval{machine}, and which coefficient the paper drew."


def _plateau(result: Reproduction) -> str:
    return (
        f"After {result.settings.memory} samples a model of this memory rests on a plateau, whatever the "
        f"machine does; {orthonormal_row(result)} forgets as slowly as the joint. The second pulse is "
        "turned round: one sign alone would not show an error that is even. Errors (NMSE) are in the "
        "titles, in the order of the legend."
    )


def _no_pulse() -> str:
    return "No pulse was recorded, so the free run on data that no model has seen takes its place."
