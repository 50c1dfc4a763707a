"""Markov chains whose stationary law is that of the exact bridge: many steps in one call.

There are three methods, each of which is also a kernel of two functions, `init` and `step`
(`kernels`):

- pseudo-marginal Metropolis–Hastings (`pseudo_marginal`), for every proposal;
- renewal (`renewal`), for couplings;
- preconditioned Crank–Nicolson moves of the noise (`crank_nicolson`), for guided proposals.
"""

import functools
from typing import Literal

import diffrax
from jaxtyping import Array, Key

from ..engine.arguments import check_choice
from ..engine.checks import Numbers, check_count, check_key
from ..engine.entry import public_entry
from ..engine.verdict import throw_where_untrustworthy
from ..models.bridge_problem import bridge_problem
from ..models.diffusion import Diffusion
from ..proposals import Budget, Guided, ProposalLike, as_guided, as_pairs, as_proposal, resolve
from .crank_nicolson import check_step_size, run_crank_nicolson
from .kernels import Chain, check_position
from .pseudo_marginal import run_pseudo_marginal
from .renewal import run_renewal


@public_entry
def sample_exact_bridges(
    key: Key[Array, ""],
    model: Diffusion,
    start: Numbers,
    end: Numbers,
    duration: Numbers,
    *,
    num_bridges: int = 1,
    num_steps: int = 50,
    position: Numbers | None = None,
    proposal: ProposalLike = None,
    method: Literal["pseudo_marginal", "renewal", "crank_nicolson"] = "pseudo_marginal",
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    step_size: Numbers | None = None,
    save_at: Numbers | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> Chain:
    """Sample a Markov chain of bridges with the exact law: section 2.3 of the paper.

    The stationary law of the chain is exact up to the discretisation error, which `num_steps`
    controls. Proposals of the pseudo-marginal chain do not depend on its state, so thousands of
    them and their counts run at a time, before the chain. The renewal chain runs in segments side
    by side, which are joined where they agree.

    The kernel of the same name as `method` gives the same chain, up to rounding, if it starts from
    `init(position, init_key)` and its steps have the keys `jax.random.split(run_key, num_bridges)`.
    Here `run_key, init_key = jax.random.split(key)`. Exception: for guided proposals and a
    state-dependent σ, kernels have Euler steps.

    **Arguments:**

    - `key`: a typed key. With I intervals the i-th chain has the key `jax.random.fold_in(key, i)`.
    - `model`, `start`, `end`, `duration`, `num_steps`, `save_at`: as in `sample_bridges`.
    - `num_bridges`: n, the number of iterations.
    - `position`: the path from which the chain starts, for instance the last one of another chain,
        shape (N+1, d) with N = `num_steps`; shape (I, N+1, d) for I intervals. By default the chain
        proposes its first path. With a `position` and a state-dependent σ, guided proposals have
        Euler steps, because a given path must determine its noise. Do not pool such draws with
        those of a chain that proposed its first path.
    - `proposal`: a `Coupling`, with its start law; a guided proposal (`ModifiedDiffusionBridge()`,
        `ResidualBridge()` or `Guided()`), whose target is a product of step densities; "auto",
        which selects the best one for each interval by a pilot run; or a result of
        `choose_proposal`. The default is `Coupling(gamma=0.0)`, and `Guided()` for
        "crank_nicolson". "renewal" needs a coupling, "crank_nicolson" a guided proposal.
    - `method`: "pseudo_marginal", "renewal" or "crank_nicolson". An iteration of "renewal" costs
        less, but a good sample takes many more iterations. "crank_nicolson" is for guided proposals
        with low acceptance: it moves the noise of the current path a little in each iteration.
    - `num_counts`: number of hitting counts for each proposal of the pseudo-marginal chain; by
        default one. Only for couplings, and not for the renewal chain.
    - `max_proposals`: bound on the attempts for each new path; by default 10,000. Only for
        couplings.
    - `max_trials`: bound on the trials for the counts of each path; by default 10,000 for each
        count. See `Chain.truncated`. Only for couplings, and not for the renewal chain.
    - `step_size`: β in (0, 1] of "crank_nicolson", by default 0.5; see `crank_nicolson`.
    - `progress_meter`: a progress meter of diffrax, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time if the result is not `trustworthy`, or if a parameter is
        not finite.

    **Returns:** `Chain`. It is not differentiable: derivatives raise `TypeError`.

    **Raises:** `ValueError` and `TypeError` for invalid arguments.

    **Example:**

    ```python
    chain = jb.sample_exact_bridges(key, model, start, end, 1.0, num_bridges=1000)
    chain.paths.shape, chain.acceptance_rate  # (1000, 51, 2)
    ```
    """
    check_key(key)
    check_choice("method", method, ("pseudo_marginal", "renewal", "crank_nicolson"))
    problem = bridge_problem(model, start, end, duration, num_steps)
    num_bridges = check_count("num_bridges", num_bridges)
    if proposal is None and method == "crank_nicolson":
        proposal = Guided()
    budget = Budget(num_counts, max_proposals, max_trials)
    # The chain needs the noise, or the weight, of a given path.
    is_given = position is not None
    proposal = as_proposal(proposal, model, problem.like, budget, normal_steps=is_given)
    proposal.check(model, problem.intervals)
    if step_size is not None and method != "crank_nicolson":
        raise ValueError(
            f'`step_size` is for method="crank_nicolson"; got method="{method}". Omit `step_size`.'
        )
    if method == "crank_nicolson":
        proposal = as_guided(proposal)
        run = functools.partial(run_crank_nicolson, beta=check_step_size(step_size))
    elif method == "renewal":
        proposal, run = as_pairs(proposal), run_renewal
        # Silently ignored arguments would mislead, so they are refused.
        if not (num_counts is None and max_trials is None):
            raise ValueError(
                "`num_counts` and `max_trials` are for the pseudo-marginal chain only; got "
                f"num_counts={num_counts} and max_trials={max_trials} for the renewal chain, which "
                "counts nothing. Omit both."
            )
    else:
        run = run_pseudo_marginal
    # Checks of arguments come first, so that errors come before any pilot run.
    first = check_position(position, problem)
    problem = problem.keep(save_at, duration, proposal.fractions(num_steps))
    # The pilot run of "auto" selects a concrete proposal here.
    proposal = resolve(proposal, key, model, problem.intervals, num_steps)
    chain = run(key, model, proposal, problem, num_bridges, first, progress_meter)
    return throw_where_untrustworthy(chain, "paths", model) if throw else chain
