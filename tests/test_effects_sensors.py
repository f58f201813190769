"""Sensors that read more than one true value: closed forms, true delays, predictor, fit, search, export."""

import math

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.interpolate

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.errors import InputError
from rotflex_jax.joints import paper, single_inertia
from rotflex_jax.mechanism import (
    Exponential,
    Mechanism,
    kalman_gains,
    predictor_run,
    simulate,
    simulate_states,
)
from rotflex_jax.mechanism.linear import state_names
from rotflex_jax.mechanism.roles import search_places
from rotflex_jax.models.model import Model
from rotflex_jax.runtime.xla import double_precision

Ts, FINE = 0.002, 40


def joint() -> Mechanism:
    return paper(hub_damping=0.004, joint_damping=0.003)


def with_tacho(machine: Mechanism) -> Mechanism:
    outputs = {"theta": "hub", "alpha": "joint", "tacho": ("hub", "speed")}
    return Mechanism(machine.coordinates, machine.ports, machine.effects, outputs)


def steps(N: int = 1000, hold: int = 10) -> np.ndarray:
    return np.repeat(np.random.default_rng(0).uniform(-5, 5, -(-N // hold)), hold)[:N]


def truly_late(machine: Mechanism, u: np.ndarray, late: float) -> tuple[np.ndarray, np.ndarray]:
    """Outputs now, and outputs `late` seconds ago by a simulation with forty times as many samples."""
    fine = simulate(machine, np.repeat(u, FINE), Ts / FINE)
    then = np.maximum(np.arange(len(u)) * FINE - round(late / Ts * FINE), 0)
    return fine[::FINE], fine[then]


@pytest.mark.parametrize("late", [0.25, 1.0, 1.5, 2.0, 3.0])
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_one_channel_comes_late(channel, late):
    """The error is below 0.5 % of the change of a position during the delay, below 7 % for a speed.

    Voltages up to 5 V jump every 20 ms; the filter rounds the corners of the speed.
    """
    machine, u = with_tacho(joint()), steps()
    name = machine.channels[channel]
    now, then = truly_late(machine, u, late * Ts)
    found = simulate(machine + fx.ChannelDelay(name, time=late * Ts), u, Ts)
    others = [c for c in range(3) if c != channel]
    np.testing.assert_allclose(found[:, others], now[:, others], rtol=0, atol=1e-12)
    error = found[:, channel] - then[:, channel]
    moved = np.std(now[:, channel] - then[:, channel])
    assert np.sqrt(np.mean(error**2)) < (0.005 if channel < 2 else 0.07) * moved


def test_the_filter_is_the_pade_approximation_of_a_delay():
    """Of order (2, 2), for a position and for a speed; reference: `scipy.interpolate.pade`."""
    time = 0.005
    above, below = scipy.interpolate.pade([1 / math.factorial(k) for k in range(5)], 2)
    W = np.geomspace(1.0, 1000.0, 30)
    s = 1j * W
    expected = above(-s * time) / below(-s * time)
    stamp = fx.ChannelDelay("theta", time=time).stamp()
    own, from_speed = np.array(stamp.own), np.array(stamp.from_speed)
    behind, rate = np.array([np.linalg.solve(p * np.eye(2) - own, from_speed) for p in s]).T
    np.testing.assert_allclose(1 - s * behind, expected, rtol=1e-10)
    np.testing.assert_allclose(1 - rate / time, expected, rtol=1e-10)
    slow = W < 100
    np.testing.assert_allclose(expected[slow], np.exp(-s[slow] * time), atol=(100 * time) ** 5 / 720)


def test_a_late_channel_beside_other_states():
    """Its states are at the right places among those of a motor current and of a gear with play."""
    plain = paper(inductance=1e-3, joint_damping=0.003)
    u = steps(400)
    for machine in (plain, plain + fx.Backlash("hub", gap=0.004), plain + fx.Coulomb("arm", 0.01)):
        late = machine + fx.ChannelDelay("alpha", time=0.003) + fx.SecondMode("arm", inertia=0.0)
        names = list(state_names(late))
        assert names[4:9] == [
            "hub.motor[0]",
            "alpha.channel_delay[0]",
            "alpha.channel_delay[1]",
            "arm.second_mode[0]",
            "arm.second_mode[1]",
        ]
        states, alone = simulate_states(late, u, Ts), simulate_states(machine, u, Ts)
        kept = [names.index(n) for n in state_names(machine)]
        np.testing.assert_allclose(states[:, kept], alone, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            simulate(late, u, Ts)[:, 1], alone[:, 1] - states[:, names.index("alpha.channel_delay[0]")]
        )


def test_a_predictor_follows_a_late_sensor():
    """With corrections by late readings, the error of a wrong first state decays."""
    machine = joint() + fx.ChannelDelay("alpha", time=0.004)
    u = steps(2000)
    y = simulate(machine, u, Ts)
    K = kalman_gains(machine, [{"hub": 1e-4, "joint": 1e-5}], np.array([5e-4, 5e-4]), Ts)[0]
    start = np.array([0.05, -0.03, 0.5, 0.2, 0.0, 0.0])
    with double_precision():
        given = [jnp.asarray(a) for a in (machine.values, np.ones(7), start, u, y, np.ones(2000), K)]
        predicted = predictor_run(machine.structure, Exponential(), *given, jnp.asarray(Ts))[1]
    error = np.abs(np.asarray(predicted) - y)
    assert error[:20].max() > 0.01 and error[1000:].max() < 1e-6


def test_cross_talk_reads_the_true_other_channel():
    u, machine = steps(300), with_tacho(joint())
    y = simulate(machine, u, Ts)
    mixed = machine + fx.SensorGain("theta", error=0.2) + fx.CrossTalk("alpha", share=0.01)
    mixed = mixed + fx.CrossTalk("theta", share=-0.03) + fx.CrossTalk("tacho", share=0.5)
    found = simulate(mixed, u, Ts)
    np.testing.assert_allclose(found[:, 0], 1.2 * y[:, 0] - 0.03 * y[:, 1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], y[:, 1] + 0.01 * y[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(found[:, 2], y[:, 2] + 0.5 * y[:, 0], rtol=0, atol=1e-12)


def test_an_encoder_out_of_centre():
    """Reference: the angle of a mark on the rim of a disc that turns about a point beside its centre."""
    radius, beside, phase = 0.02, 0.0001, 0.6
    turn = np.linspace(-3.0, 13.0, 400)
    rim = radius * np.exp(1j * turn) + beside * np.exp(1j * phase)
    seen = np.unwrap(np.angle(rim))
    share = beside / radius
    encoder = fx.EccentricEncoder("theta", cosine=share * np.sin(phase), sine=-share * np.cos(phase))
    with double_precision():
        found = np.asarray(encoder.measure(jnp.asarray(turn)))
    np.testing.assert_allclose(found, seen, rtol=0, atol=0.6 * share**2)
    assert np.abs(seen - turn).max() > 0.9 * share
    assert f"{share:.3g} rad" in encoder.sentence()


def test_a_fit_finds_delay_share_and_eccentricity():
    true = joint() + fx.ChannelDelay("alpha", time=0.0034)
    true = true + fx.CrossTalk("alpha", share=0.012) + fx.EccentricEncoder("theta", cosine=0.004, sine=-0.011)
    start = true.with_values(
        {
            "alpha.channel_delay.time": 0.001,
            "alpha.cross_talk.share": 0.0,
            "theta.eccentric_encoder.cosine": 0.0,
            "theta.eccentric_encoder.sine": 0.0,
            "joint.spring.stiffness": 1.5,
        }
    )
    u = steps(3000, 25)
    y = simulate(true, u, Ts) + 5e-4 * np.random.default_rng(1).normal(size=(3000, 2))
    fit = rf.fit(start, rf.Recording(u=u, y=y, Ts=Ts, accept=("units",)))
    names = fit.model.mechanism.parameter_names
    found = dict(zip(names, fit.model.mechanism.values, strict=True))
    assert found["alpha.channel_delay.time"] == pytest.approx(0.0034, abs=1e-4)
    assert found["alpha.cross_talk.share"] == pytest.approx(0.012, abs=3e-4)
    assert found["theta.eccentric_encoder.cosine"] == pytest.approx(0.004, abs=3e-4)
    assert found["theta.eccentric_encoder.sine"] == pytest.approx(-0.011, abs=3e-4)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: single_inertia() + fx.CrossTalk("theta"), "output 'theta', but it needs a second output"),
        (lambda: with_tacho(joint()) + fx.EccentricEncoder("tacho"), "needs a position there"),
        (lambda: joint() + fx.ChannelDelay("hub"), "this mechanism has 'theta', 'alpha' for it"),
        (lambda: fx.ChannelDelay("alpha", time=0.0), "between 5e-05 and inf"),
    ],
)
def test_what_cannot_be(wrong, message):
    with pytest.raises(InputError, match=message):
        wrong()


def test_a_search_leaves_out_what_a_sensor_cannot_have():
    machine = with_tacho(joint())
    places = {(cls.name, place) for cls, place in search_places(machine)}
    assert ("eccentric_encoder", "tacho") not in places and ("eccentric_encoder", "theta") in places
    assert {place for name, place in places if name == "channel_delay"} == {"theta", "alpha", "tacho"}
    alone = {cls.name for cls, _ in search_places(single_inertia())}
    assert not alone & {"cross_talk", "channel_delay", "sensor_gain"} and "eccentric_encoder" in alone


def test_a_linear_model_and_a_file_have_the_late_sensor(tmp_path):
    model = Model(joint() + fx.ChannelDelay("alpha", time=0.004) + fx.CrossTalk("alpha", share=0.02))
    u = steps(200)
    linear = rf.export.state_space(model, Ts=Ts)
    x, y = np.zeros(len(linear.A)), []
    for k in range(len(u)):
        y.append(linear.C @ x)
        x = linear.A @ x + linear.B[:, 0] * u[k]
    expected = simulate(model.mechanism, u, Ts)
    np.testing.assert_allclose(y, expected, rtol=0, atol=1e-10)
    model.save(tmp_path / "model.json")
    again = Model.load(tmp_path / "model.json")
    np.testing.assert_array_equal(simulate(again.mechanism, u, Ts), expected)


def test_the_largest_reading_is_the_top_of_the_characteristic():
    """Reference: the maximum of the characteristic on a fine grid, up to where its slope changes sign."""
    v = np.linspace(0.0, 1.0, 100_001)
    bent = fx.SensorCubic("alpha", cubic=-2.0)
    assert bent.largest_reading() == pytest.approx(float(np.max(bent.measure(v))), rel=1e-8)
    assert fx.SensorCubic("alpha", cubic=2.0).largest_reading() == math.inf


def test_a_bias_has_the_unit_of_its_channel(tmp_path):
    m = rf.Mechanism(
        ("a",),
        {"shaft": (1,)},
        [fx.Inertia("shaft", inertia=0.1), fx.Motor("shaft"), fx.CurrentMeter("shaft")],
        outputs={"angle": "shaft", "tacho": ("shaft", "speed"), "amps": ("shaft", "current")},
    )
    for channel, unit in {"angle": "rad", "tacho": "rad/s", "amps": "A"}.items():
        m = m + fx.SensorBias(channel, bias=0.02)
        assert m.parameter_specifications[-1].unit == unit
        assert f"+0.02 {unit}" in m.sentence(m.effects[-1])
    assert str(m).endswith("tacho.sensor_bias.bias = 0.02 rad/s\n  amps.sensor_bias.bias = 0.02 A")
    Model(m).save(tmp_path / "model.json")
    assert Model.load(tmp_path / "model.json").mechanism == m
