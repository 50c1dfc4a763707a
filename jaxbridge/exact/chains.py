"""Markov chains whose law is that of the exact bridge: very many steps in one call.

* Pseudo-marginal Metropolis–Hastings (`pseudo_marginal`), for every proposal.
* Renewal (`renewal`), for couplings.
* Preconditioned Crank–Nicolson moves of the noise (`crank_nicolson`), for proposals that are
  pulled to the end point.

Each comes as a kernel of two functions, `init` and `step`, too (`kernels`).
"""

import functools
from typing import Any, Literal

import diffrax
from jaxtyping import Array, Key

from ..engine.arguments import check_choice
from ..engine.checks import Numbers, check_count, check_key
from ..engine.doors import door
from ..engine.verdict import throw_where_untrustworthy
from ..models.bridge_problem import bridge_problem
from ..models.diffusion import Diffusion
from ..proposals import Budget, Guided, as_guided, as_pairs, as_proposal, resolve
from .crank_nicolson import check_step_size, run_crank_nicolson
from .kernels import Chain, check_position
from .pseudo_marginal import run_pseudo_marginal
from .renewal import run_renewal


@door
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
    proposal: Any = None,
    method: Literal["pseudo_marginal", "renewal", "crank_nicolson"] = "pseudo_marginal",
    num_counts: int | None = None,
    max_proposals: int | None = None,
    max_trials: int | None = None,
    step_size: Numbers | None = None,
    save_at: Numbers | None = None,
    progress_meter: diffrax.AbstractProgressMeter | None = None,
    throw: bool = False,
) -> Chain:
    """A Markov chain of bridges with the exact law: section 2.3 of the paper.

    The law is exact up to the step error, which `num_steps` controls. Proposals do not depend
    on the chain, so they and their counts are made ahead, thousands at a time; the renewal
    chain runs in segments that are joined where they agree. The chain is, up to rounding, that
    of the kernel: with `run_key, init_key = jax.random.split(key)`, the one that starts from
    `init(position, init_key)` and steps with `jax.random.split(run_key, num_bridges)`.

    **Arguments:**

    - `key`: a typed key. With I intervals the i-th chain has the key
        `jax.random.fold_in(key, i)`.
    - `model`, `start`, `end`, `duration`, `num_steps`, `save_at`: as in `sample_bridges`.
    - `num_bridges`: n, the number of iterations.
    - `position`: the path from which the chain starts, shape (N+1, d), for instance the last of
        another; (I, N+1, d) for I intervals. By default a first path is proposed.
    - `proposal`: a `Coupling`, with its start law, by default `Coupling(gamma=0.0)`; or
        `ModifiedDiffusionBridge()`, `ResidualBridge()` or `Guided()` (the default of
        "crank_nicolson"), whose target is made of the densities of their steps; or "auto",
        which finds the best for each interval by a pilot run, or
        what `choose_proposal` returns.
    - `method`: "pseudo_marginal"; "renewal", for couplings, which needs many more iterations for
        bridges as good, each of which costs less; or "crank_nicolson", for proposals that are
        pulled to the end point, where few of them are accepted: it moves the noise of the current
        path a little in each iteration.
    - `num_counts`: N, hitting counts for each proposal of the pseudo-marginal chain; by default
        one.
    - `max_proposals`: bounds the tries for each new path; by default 10,000.
    - `max_trials`: bounds the trials for the counts of each path; by default 10,000 for each
        count. See `Chain.truncated`. It and `num_counts` are not for the renewal chain.
    - `step_size`: β in (0, 1] of "crank_nicolson", by default 0.5; see `crank_nicolson`.
    - `progress_meter`: one of diffrax's, for instance `diffrax.TextProgressMeter()`.
    - `throw`: raise an error at run time where the result is not `trustworthy`, or parameters are
        not finite.

    **Returns:** `Chain`. Not differentiable.

    **Raises:** `ValueError` and `TypeError` for arguments that do not fit.

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
    proposal = as_proposal(proposal, model, problem.like, budget)
    proposal.check(model, problem.intervals)
    if step_size is not None and method != "crank_nicolson":
        raise ValueError('`step_size` is for method="crank_nicolson".')
    if method == "crank_nicolson":
        proposal = as_guided(proposal)
        run = functools.partial(run_crank_nicolson, beta=check_step_size(step_size))
    elif method == "renewal":
        proposal, run = as_pairs(proposal), run_renewal
        if not (num_counts is None and max_trials is None):
            raise ValueError(
                "`num_counts` and `max_trials` are for the pseudo-marginal chain: the renewal "
                "chain counts nothing."
            )
    else:
        run = run_pseudo_marginal
    first = check_position(position, problem)
    problem = problem.keep(save_at, duration, proposal.fractions(num_steps))
    proposal = resolve(proposal, key, model, problem.intervals, num_steps)
    chain = run(key, model, proposal, problem, num_bridges, first, progress_meter)
    return throw_where_untrustworthy(chain, "paths", model) if throw else chain
