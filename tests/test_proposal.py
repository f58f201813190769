"""What a search proposes to record next where it could not decide."""

import dataclasses
import json

import numpy as np
import pytest

import rotflex_jax as rf
import rotflex_jax.effects as fx
from rotflex_jax.data.excitation import noise
from rotflex_jax.discover import conclusion
from rotflex_jax.discover.conclusion import proposed, seen_limits, with_proposal
from rotflex_jax.discover.discovery import Discovery
from rotflex_jax.discover.result import NEXT, Round, Stage
from rotflex_jax.discover.verdict import Verdict
from rotflex_jax.mechanism import simulate
from rotflex_jax.models.model import Model

TS, SD = 0.01, 5e-4


def found(verdict: Verdict = Verdict.AMBIGUOUS) -> Discovery:
    """A delay that could as well be a lag, as a search would tell it."""
    m = rf.joints.paper(joint_damping=0.003, hub_damping=0.004)
    grown = m + fx.Delay(time=0.012)
    u = noise(400, TS, rms=0.8, seed=1)
    y = simulate(grown, u, TS) + SD * np.random.default_rng(0).standard_normal((400, 2))
    rec = rf.Recording(u=u, y=y, Ts=TS)
    errors = {"theta": SD, "alpha": SD}
    stages = [
        Stage(Model(x), (), errors, errors, (y,), (y,), 2.0, {"hub": 0.0, "joint": 0.0}, 0.0, 0.0)
        for x in (m, grown)
    ]
    turn = Round("delay", "input", (("lag", "input"),), {}, stages[1], 1.0, 1.0, "late", "v(t) = u(t - time)")
    return Discovery(verdict, "Either.", (rec,), (rec,), stages[0], (turn,), (), (), errors, 1.0)


@pytest.fixture(scope="module")
def answered():
    old, conclusion.PROPOSAL_SECONDS = conclusion.PROPOSAL_SECONDS, 3.0
    yield with_proposal(found())
    conclusion.PROPOSAL_SECONDS = old


def test_the_best_standard_input_is_proposed_within_what_the_machine_has_borne(answered):
    e, limits = answered.proposal, seen_limits(answered.train)
    assert e.separates == ("delay@input", "lag@input")
    assert e.chosen.input in {"noise", "multisine", "prbs", "steps", "sweep"}
    assert np.max(np.abs(e.u)) <= limits.voltage == np.max(np.abs(answered.train[0].u))
    assert e.chosen.peaks["alpha"] <= limits.deflection
    assert e.numbers["delay@input"]["time"] == 0.012
    # The lag that looks like that delay.
    assert e.numbers["lag@input"]["time"] == pytest.approx(0.012, rel=0.5)
    assert e.chosen.nats > 1


def test_the_json_keeps_its_contract(answered):
    told = json.loads(json.dumps(answered.to_dict()))["next_experiment"]
    assert told["separates"] == ["delay@input", "lag@input"]
    assert told["input"] == answered.proposal.chosen.input
    assert told["file"] == NEXT


@pytest.mark.parametrize("verdict", sorted(set(Verdict) - {Verdict.AMBIGUOUS}))
def test_nothing_is_proposed_where_nothing_is_open(verdict):
    plain = found(verdict)
    assert with_proposal(plain) is plain
    assert plain.to_dict()["next_experiment"] is None


def test_no_design_without_an_equal():
    alone = dataclasses.replace(found(), rounds=())
    assert proposed(alone) is None and alone.next_experiment() is None


def test_a_proposal_that_fails_is_a_note():
    """An effect that the catalogue lacks, for one."""
    result = found()
    turn = dataclasses.replace(result.rounds[0], equivalent=(("unknown", "input"),))
    told = with_proposal(dataclasses.replace(result, rounds=(turn,)))
    assert told.proposal is None
    assert "No next experiment" in told.notes[-1] and "unknown" in told.notes[-1]
