"""A saved model is loaded without any change of effects, values and settings."""

import dataclasses
import json

import numpy as np
import pytest

import rotflex_jax as rf
from rotflex_jax.effects import CATALOG, BoucWen, Coulomb, LearnedTorque, Motor
from rotflex_jax.effects.base import Actuation, Sensing
from rotflex_jax.errors import InputError
from rotflex_jax.export import Saved, read, save
from rotflex_jax.joints import paper
from rotflex_jax.mechanism import Exponential, Mechanism, SmoothRK4
from rotflex_jax.mechanism.quantity import Units
from rotflex_jax.models.model import Model
from rotflex_jax.recording import Recording
from rotflex_jax.runtime.program_files import static_key

AWKWARD = (0.1 + 0.2, 1 / 3, np.pi * 1e-9, 5e-324, 1.7976931348623157e308)


def place(cls) -> str:
    if issubclass(cls, Actuation):
        return "input"
    if cls.acts_on == "signal":
        return "hub: signal"
    return "alpha" if issubclass(cls, Sensing) else "hub"


def reloaded(model: Model, folder) -> Model:
    return Model.load(model.save(folder / "model.json"))


@pytest.mark.parametrize("name", sorted(CATALOG))
def test_every_effect_comes_back_as_it_was(name, tmp_path):
    cls = CATALOG[name]
    numbers = {n: s.lower + 1 / 3 if np.isfinite(s.lower) else -1 / 3 for n, s in cls.declared().items()}
    effect = cls(at=place(cls), **numbers)
    others = [e for e in paper().effects if (e.name, e.at) != (name, effect.at)]
    others += [CATALOG["position_servo"]("hub")] if "servo" in cls.needs() else []
    mechanism = dataclasses.replace(paper(), effects=(*others, effect), trusted=())
    model = Model(mechanism)
    back = reloaded(model, tmp_path)
    assert back == model
    assert back.mechanism.values.tobytes() == mechanism.values.tobytes()  # to the last bit


def test_awkward_numbers_keep_every_bit(tmp_path):
    for number in AWKWARD:
        model = Model(paper() + Coulomb("hub", level=number))
        assert reloaded(model, tmp_path).mechanism.values.tobytes() == model.mechanism.values.tobytes()


def test_machine_solver_gates_and_trust_come_back(tmp_path):
    mechanism = Mechanism(
        coordinates=("phi", "psi"),
        ports={"motor": (1, 0), "belt": (-1, 1.5), "drum": (0, 1)},
        effects=[
            Motor(at="motor", inductance=1e-3),
            CATALOG["inertia"](at="motor", inertia=1.0),
            CATALOG["inertia"](at="drum", inertia=2.0),
            LearnedTorque(at="drum", count=(1, 5), weights=(0.1, -0.2, 1 / 3, 0.0, 1e-17)),
        ],
        outputs={"encoder": "motor", "tacho": ("drum", "speed")},
        trusted=("motor.motor.resistance", "drum.inertia.inertia"),
        units=Units("m", "N", 2.0, 30.0),
    )
    for solver in (Exponential(order=4, substeps=3, passes=2), SmoothRK4(width=0.01, substeps=5)):
        model = Model(mechanism, solver, gates=(1.0, 1.0, 1.0, 0.0))
        assert reloaded(model, tmp_path) == model


def recording(model: Model, N: int = 600) -> Recording:
    rng = np.random.default_rng(5)
    u = np.cumsum(rng.normal(size=N)) / 4
    y = rf.simulate(model.mechanism, u, 0.004) + 1e-4 * rng.normal(size=(N, 2))
    return Recording(u=u, y=y, Ts=0.004)


@pytest.mark.parametrize(
    "solver",
    [
        Exponential(order=np.int64(4), substeps=np.int64(2), passes=2.0),
        SmoothRK4(np.float32(0.5), np.int32(3)),
    ],
)
def test_a_solver_with_numbers_of_numpy_comes_back(tmp_path, solver):
    model = Model(paper(), solver)
    assert reloaded(model, tmp_path) == model
    assert static_key(solver)


def test_a_fit_is_saved_with_its_estimates_and_simulates_the_same(tmp_path):
    run = recording(Model(paper(hub_damping=0.01) + Coulomb("hub", level=0.02)))
    fit = rf.fit(paper(stiffness=1.4) + Coulomb("hub", level=0.005), run)
    saved = read(fit.save(tmp_path / "fit.json"))
    assert np.array_equal(saved.model.simulate(run), fit.model.simulate(run))
    for a, b in zip(saved.estimates, fit.parameters, strict=True):
        assert (a.name, a.value, a.unit, a.free, a.note) == (b.name, b.value, b.unit, b.free, b.note)
        np.testing.assert_array_equal((a.std, *a.ci95), (b.std, *b.ci95))
    np.testing.assert_array_equal(saved.covariance, fit.covariance)
    assert saved.covariance_names == fit.free_names


def test_people_can_read_it(tmp_path):
    path = save(Saved(Model(paper()), Ts=0.002, n_init=50), tmp_path / "m.json")
    data = json.loads(path.read_text())
    assert (data["kind"], data["schema"]) == ("rotflex_jax model", 1)
    spring = next(e for e in data["mechanism"]["effects"] if e["effect"] == "spring")
    assert spring["at"] == "joint" and spring["parameters"]["stiffness"] == {
        "value": 1.61,
        "unit": "N m/rad",
        "bounds": [0.0, None],
        "trusted": False,
        "meaning": "torque per angle",
    }
    assert data["data"] == {"Ts": 0.002, "n_init": 50}
    arm = next(e for e in data["mechanism"]["effects"] if (e["effect"], e["at"]) == ("inertia", "arm"))
    assert arm["parameters"]["inertia"]["trusted"]


def changed(tmp_path, change) -> str:
    path = Model(paper() + BoucWen("joint")).save(tmp_path / "m.json")
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    return str(path)


def rename(data):
    data["mechanism"]["effects"][-1]["effect"] = "ether_drag"


def other_unit(data):
    data["mechanism"]["effects"][-1]["parameters"]["width"]["unit"] = "deg"


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (rename, r"the effect 'ether_drag', which is not in the catalogue; import the module"),
        (other_unit, r"the parameter width \[deg\], but the effect has level \[N m\], width \[rad\]"),
        (lambda d: d.update(schema=2), "has schema 2, but this version reads up to 1; install a later"),
        (lambda d: d.update(kind="recipe"), "is no model file"),
        (lambda d: d["solver"].update(rule="Euler"), "the solver 'Euler', but Exponential, SmoothRK4"),
        (lambda d: d.pop("gates"), r"is incomplete or was changed by hand \(KeyError: 'gates'\)"),
        (lambda d: d["mechanism"].update(ports={"hub": [1]}), "coordinates"),
    ],
)
def test_refuses_what_it_cannot_read_in_one_sentence(tmp_path, change, sentence):
    with pytest.raises(InputError, match=sentence) as error:
        Model.load(changed(tmp_path, change))
    assert "\n" not in str(error.value)


def test_refuses_what_is_no_file(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        Model.load(tmp_path / "none.json")
    (tmp_path / "cut.json").write_text('{"kind": ')
    with pytest.raises(InputError, match="is not JSON"):
        Model.load(tmp_path / "cut.json")


def test_refuses_to_save_what_nobody_could_read_back(tmp_path):
    class Private(Coulomb):
        name = "private"

    with pytest.raises(InputError, match=r"Private at hub is not in the catalogue.*put @register"):
        Model(paper() + Private("hub")).save(tmp_path / "m.json")
