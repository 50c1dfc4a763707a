"""A proposal for each interval: the choice is the best one, and what is chosen stays exact."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import assert_weighted_moments, chosen_of, count_compilations, paper_model

import jaxbridge as jb
from jaxbridge.proposals.auto import as_proposal
from jaxbridge.proposals.choice import Choice, best_at_worst, best_of_few, worth_a_pilot

slow = pytest.mark.slow
HYPERBOLIC = jb.hyperbolic(0.8, 2)
BLIND = jb.Diffusion(lambda x, p: -p * x, None, None, 1.0)
CANDIDATES = [jb.ModifiedDiffusionBridge(), jb.Guided(), jb.Coupling(0.0)]


def mixed_choice(model, num_intervals):
    """Proposals in turn, whatever is best."""
    proposals = tuple(as_proposal(candidate, model, jnp.zeros(2)) for candidate in CANDIDATES)
    chosen = jnp.arange(num_intervals, dtype=jnp.int32) % 3
    return chosen_of(proposals, chosen, (0, 1, 2))


def test_best_where_it_is_worst():
    """Of three pilot runs of each interval; where one was left out, by what it could be."""
    proposals = tuple(
        as_proposal(candidate, paper_model(), jnp.zeros(2)) for candidate in CANDIDATES
    )
    efficiency = np.array(
        [
            [0.9, 0.9, 0.001, 0.9, 0.8, 0.9],
            [0.3, 0.2, 0.2, 0.7, 0.7, 0.7],
            [np.nan, 0.1, 0.1, np.nan, np.nan, np.nan],
        ]
    )
    seconds, nothing = jnp.ones((3, 6)), jnp.zeros((3, 6))
    told = (seconds, jnp.asarray(efficiency, jnp.float32), nothing, nothing)
    choice = best_at_worst(Choice(proposals, *told, jnp.zeros(6, jnp.int32), (0, 1, 2)), 3)
    assert list(choice.chosen) == [1, 0] and choice.used == (0, 1)


def test_what_was_never_tried_is_not_chosen():
    """A candidate without a pilot run may be anything: neither for groups nor for all."""
    proposals = tuple(
        as_proposal(candidate, paper_model(), jnp.zeros(2)) for candidate in CANDIDATES
    )
    efficiency = np.full((3, 6), np.nan)
    efficiency[0] = [0.9, 0.9, 0.2, 0.9, 0.9, 0.9]
    told = (jnp.ones((3, 6)), jnp.asarray(efficiency, jnp.float32), *2 * [jnp.zeros((3, 6))])
    choice = Choice(proposals, *told, jnp.zeros(6, jnp.int32), (0,))
    assert best_at_worst(choice, 3).used == (0,) and choice.for_all() is proposals[0]


def test_few_candidates_serve_many_intervals():
    """All together lose a twentieth of the work at most, and none more could be left out; but a
    candidate that some intervals cannot do without stays."""
    rng = np.random.default_rng(0)
    rates = jnp.asarray(np.exp(0.3 * rng.normal(size=(50, 4, 30))), jnp.float32)
    chosen = np.asarray(jax.vmap(best_of_few)(rates))
    numbers = []
    for each, of_interval in zip(np.asarray(rates, float), chosen, strict=True):
        used = np.unique(of_interval)
        best, numbers = each.max(axis=0), [*numbers, len(used)]
        np.testing.assert_array_equal(of_interval, used[each[used].argmax(axis=0)])
        loss = lambda rates, best=best: max(
            np.mean(best / rates), np.sum(1 / rates) / np.sum(1 / best)
        )
        assert loss(each[of_interval, np.arange(30)]) <= 1.05
        for i in used if len(used) > 1 else ():
            assert loss(each[used[used != i]].max(axis=0)) > 1.05
    assert set(numbers) >= {3, 4}
    nearly = jnp.array([[1.0, 1.0, 1.0], [1.04, 0.9, 1.1], [np.nan, np.nan, 0.1]])
    assert list(best_of_few(nearly)) == [1, 1, 1]
    needed = jnp.array([[1.0, 1.0, 1e-6], [0.5, 0.5, 0.5], [np.nan, np.nan, 0.4]])
    assert list(best_of_few(needed)) == [0, 0, 1]
    hard = jnp.ones((2, 1000)).at[1].set(0.5).at[:, 7].set(jnp.array([1e-4, 4e-3]))
    assert np.flatnonzero(best_of_few(hard)).tolist() == [7]  # it takes a tenth of the work
    for equal in (jnp.zeros((5, 3)), jnp.full((5, 3), jnp.nan), jnp.ones((5, 3))):
        assert list(best_of_few(equal)) == [0, 0, 0]


def test_a_candidate_that_would_gain_next_to_nothing_makes_no_pilot_run():
    potential = jnp.array([0.77, 0.77, 0.77, 0.77])
    assert not worth_a_pilot(potential, jnp.array([0.95, 0.9, 0.7, 0.8])).any()
    few = np.asarray(worth_a_pilot(potential, jnp.array([0.95, 0.9, 0.4, 0.8])))
    assert few.tolist() == [False, False, True, False]
    assert worth_a_pilot(potential, jnp.zeros(4)).all()
    one_is_hard = jnp.full(1000, 0.9).at[7].set(0.005)
    assert np.flatnonzero(worth_a_pilot(jnp.full(1000, 0.14), one_is_hard)).tolist() == [7]


@slow
def test_many_intervals_of_one_kind_take_one_proposal():
    """Of so many pilot runs some show heavy tails by chance, which called for other programs."""
    rng = np.random.default_rng(0)
    starts, ends = rng.normal(size=(2, 200, 2)).astype(np.float32) * 0.7
    model = jb.Diffusion(lambda x, p: -x, log_stationary=lambda x, p: -x @ x)
    choice = jb.transition_log_density(
        jax.random.key(0), model, starts, ends, 0.5, num_proposals=10, num_steps=10, proposal="auto"
    ).proposal
    assert choice.used == (0,) and np.isnan(choice.pareto_k).all()
    assert "ModifiedDiffusionBridge" in str(choice) and "200 of 200" in str(choice)


@slow
def test_each_interval_gets_what_its_own_proposal_gives():
    """In one compiled call: the same paths and weights, lane by lane, as one by one."""
    model, num = paper_model(), 7
    rng = np.random.default_rng(0)
    starts, ends = rng.normal(size=(2, num, 2)).astype(np.float32) * 0.5
    durations = rng.uniform(0.3, 1.0, num).astype(np.float32)
    options = dict(num_bridges=5, num_steps=10)
    arguments = (jax.random.key(0), model, starts, ends, durations)
    mixed = jb.sample_weighted_bridges(*arguments, **options, proposal=mixed_choice(model, num))
    for i, candidate in enumerate(CANDIDATES):
        alone = jb.sample_weighted_bridges(*arguments, **options, proposal=candidate)
        mine = np.arange(num) % 3 == i
        np.testing.assert_allclose(mixed.paths[mine], alone.paths[mine], atol=1e-5)
        np.testing.assert_allclose(mixed.log_weights[mine], alone.log_weights[mine], atol=1e-4)
        np.testing.assert_array_equal(mixed.num_simulated[mine], alone.num_simulated[mine])
    assert mixed.met.all()


@pytest.mark.slow
def test_thousands_of_intervals_with_different_choices_keep_the_law():
    """Densities of 1,500 intervals, a third by each proposal, against the closed form, without
    compiling again when numbers change."""
    model, num, steps = paper_model(), 1_500, 60
    rng = np.random.default_rng(1)
    starts, ends = rng.normal(size=(2, num, 2)).astype(np.float32) * 0.4

    def run(seed, duration):
        durations = jnp.full(num, duration)
        return jb.transition_log_density(
            jax.random.key(seed), model, starts, ends, durations, num_proposals=60,
            num_steps=steps, proposal=mixed_choice(model, num),
        )  # fmt: skip

    run(0, 0.5)
    with count_compilations() as compiled:
        estimate = run(1, 0.4)
        jax.block_until_ready(estimate.value)
    assert len(compiled) == 0
    exact = jax.vmap(lambda a, b: jb.ou_transition(model, a, 0.4).log_density(b))(starts, ends)
    ratio = np.exp(np.asarray(estimate.value - exact, float))
    chosen = np.arange(num) % 3
    for i in range(3):
        mine = ratio[chosen == i]
        error = mine.std() / np.sqrt(len(mine))
        assert error < 0.05
        assert abs(mine.mean() - 1) < 5 * error + 0.02  # the allowance is for the step


@pytest.mark.parametrize(
    "duration, model, winners",
    [
        pytest.param(0.05, HYPERBOLIC, {"ModifiedDiffusionBridge"}, marks=slow),
        (1.0, HYPERBOLIC, {"ModifiedDiffusionBridge"}),
        pytest.param(2.0, paper_model(), {'Guided("end")', 'Guided("path")'}, marks=slow),
        pytest.param(4.0, BLIND, {'Guided("end")', 'Guided("path")'}, marks=slow),
    ],
)
@pytest.mark.slow
def test_auto_takes_what_theory_says_is_best(duration, model, winners):
    """Brownian bridges where the drift hardly matters, and the true density of a linear process."""
    chain = jb.sample_exact_bridges(
        jax.random.key(0), model, [0.3, 0.1], [2.0, -1.0], duration, num_bridges=200,
        num_steps=max(50, round(10 * duration)), proposal="auto", save_at=[duration / 2],
    )  # fmt: skip
    lines = str(chain.proposal).splitlines()
    assert next(line.split("  ")[0] for line in lines if "1 of 1" in line) in winners
    assert chain.met.all() and chain.acceptance_rate > 0.3


@pytest.mark.slow
def test_a_candidate_that_cannot_win_makes_no_pilot_run():
    """Of a coupling's simulated paths at most one in two is an effective sample."""
    choice = jb.choose_proposal(
        jax.random.key(0), paper_model(), [[0.0, 0.0]], [[0.3, 0.1]], [0.05], num_steps=20
    )
    efficiency = np.asarray(choice.efficiency)[:, 0]
    assert efficiency[0] > 0.9 and np.isnan(efficiency[-2:]).all()
    assert "chosen for" in str(choice) and "1 of 1" in str(choice)


@pytest.mark.slow
def test_densities_are_not_mixed_where_they_have_different_constants():
    """A coupling from draws of the stationary law needs a normalised log ν; the others none."""
    model = jb.Diffusion(
        lambda x, p: -1.5 * x,
        None,
        lambda x, p: 7 - 1.5 * x @ x,
        reversible=True,
        sample_stationary=lambda key, p: jax.random.normal(key, (2,)) / jnp.sqrt(3),
    )
    arguments = (jax.random.key(0), model, [[0.0, 0.0], [0.3, 0.1]], [0.3, 0.1], 0.1)
    estimate = jb.transition_log_density(
        *arguments, num_steps=10, num_proposals=20, proposal="auto"
    )
    assert not any(isinstance(c, jb.CoupledPairs) for c in estimate.proposal.candidates)
    mixed = mixed_choice(model, 2)
    with pytest.raises(ValueError, match="in proportion to exp of `log_stationary`"):
        jb.transition_log_density(*arguments, num_steps=10, num_proposals=2, proposal=mixed)


@pytest.mark.slow
def test_what_is_not_used_asks_for_nothing():
    """A kernel from a choice that left the couplings out, for a model that they could not start
    from; and a model whose ν is unknown."""
    model = jb.langevin(lambda x, p: -1.5 * x @ x)
    ends = ([0.0, 0.0], [0.3, 0.1], 0.05)
    choice = jb.choose_proposal(jax.random.key(0), model, *ends, num_steps=10)
    kernel = jb.pseudo_marginal(model, *ends, num_steps=10, proposal=choice)
    assert kernel.init(None, jax.random.key(1)).position.shape == (11, 2)
    blind = jb.Diffusion(lambda x, p: -x, reversible=True)
    estimate = jb.transition_log_density(
        jax.random.key(0), blind, *ends, num_steps=10, num_proposals=20, proposal="auto"
    )
    assert np.isfinite(estimate.value)


@pytest.mark.slow
def test_inside_jit_the_choice_goes_by_rule():
    model = HYPERBOLIC
    starts, ends = jnp.zeros((3, 2)), jnp.array([[0.1, 0.0], [0.5, 0.5], [1.0, -1.0]])

    @jax.jit
    def run(durations):
        return jb.transition_log_density(
            jax.random.key(0), model, starts, ends, durations, num_proposals=50, num_steps=20,
            proposal="auto",
        )  # fmt: skip

    estimate = run(jnp.array([0.02, 0.1, 0.5]))
    assert np.isfinite(estimate.value).all() and (estimate.standard_error < 0.1).all()
    assert (estimate.proposal.chosen == 0).all()
    alone = jb.transition_log_density(
        jax.random.key(0), model, starts, ends, jnp.array([0.02, 0.1, 0.5]), num_proposals=50,
        num_steps=20, proposal=jb.ModifiedDiffusionBridge(jb.ItoTaylorDensity()),
    )  # fmt: skip
    np.testing.assert_allclose(alone.value, estimate.value, atol=1e-4)


@slow
def test_choice_for_one_interval_tunes_a_coupling():
    """On a long interval of a nonlinear process couplings are best."""
    choice = jb.choose_proposal(
        jax.random.key(0), HYPERBOLIC, [0.0, 0.0], [2.0, 1.0], 60.0, num_steps=600
    )
    assert len(choice.candidates) == 6 and choice.chosen[0] >= 3
    kernel = jb.pseudo_marginal(
        HYPERBOLIC, [0.0, 0.0], [2.0, 1.0], 60.0, num_steps=600, proposal=choice
    )
    state = kernel.init(None, jax.random.key(0))
    state, _ = kernel.step(jax.random.key(1), state)
    assert np.isfinite(state.log_weight)


@slow
def test_auto_has_the_exact_law():
    model, ends = paper_model(), ([0.785, 0.785], [1.091, 1.091])
    weighted = jb.sample_weighted_bridges(
        jax.random.key(0), model, *ends, 1.0, num_bridges=20_000, num_steps=400, proposal="auto",
        save_at=[0.5],
    )  # fmt: skip
    law = jb.gaussian_bridge(model, *ends, 1.0, [0.5])
    assert_weighted_moments(
        weighted.paths[:, 0], weighted.weights, law.mean[0], law.covariance[0], allowance=0.015
    )


@slow
def test_no_derivative_is_taken_of_a_choice_with_couplings(unchecked):
    key, model = jax.random.key(0), paper_model()
    for proposal in (mixed_choice(model, 3), "auto"):
        with pytest.raises(TypeError, match=r"`choice = choose_proposal\(..., candidates="):
            jax.grad(
                lambda b, proposal=proposal: jb.sample_weighted_bridges(
                    key, model, jnp.zeros((3, 2)), b, 1.0, num_bridges=2, proposal=proposal
                ).mean()[0, 5, 0]
            )(jnp.full((3, 2), 0.3))


@pytest.mark.slow
def test_what_a_proposal_makes_of_another_ones_interval_does_not_spoil_derivatives():
    """Where the explicit path of a guide overflows its derivative is not a number, times zero as
    well."""
    model = jb.Diffusion(lambda x, p: -p * x**5, params=1.0)
    starts, ends = jnp.array([[0.0], [6.0]]), jnp.array([[0.3], [6.1]])
    guided, bridge = jb.Guided("path"), jb.ModifiedDiffusionBridge()
    choice = chosen_of((bridge, guided), jnp.array([1, 0], jnp.int32), (0, 1))

    def first(params, proposal):
        return jb.transition_log_density(
            jax.random.key(0), model.with_params(params), starts, ends, 0.5, num_proposals=4,
            num_steps=5, proposal=proposal,
        ).value[0]  # fmt: skip

    found = jax.grad(first)(jnp.asarray(1.0), choice)
    expected = jax.jacfwd(first)(jnp.asarray(1.0), guided)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.slow
def test_what_auto_leaves_out_is_said():
    """An undeclared normaliser, for densities only; and an unknown time reversal."""
    key, ends, model = jax.random.key(0), ([0.0], [0.3], 0.1), jb.langevin(lambda x, p: -x @ x)
    options = dict(num_steps=5, proposal="auto")
    density = jb.transition_log_density(key, model, *ends, num_proposals=4, **options)
    lines = str(density.proposal).splitlines()
    assert lines[-1].startswith("couplings left out: ") and "normalised=True" in lines[-1]
    undecided = as_proposal("auto", model, jnp.zeros(1), for_density=True)
    assert "couplings left out: " in str(undecided)
    assert "left out" not in str(as_proposal("auto", model, jnp.zeros(1)))
    blind = as_proposal("auto", BLIND, jnp.zeros(1))
    assert "time reversal" in blind.left_out
