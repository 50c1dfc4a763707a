"""Proposals of bridges: paths with unbiased weights.

A proposal (`base`) draws paths with weights w such that, for every function h,

    E[w h(path)] = p_T(a, b) E_bridge[h].

It also reports its cost and its target law, and measures before use what its paths need, such as a
burn-in.

- `coupled`: coupled pairs, with random weights from hitting counts.
- `guided`: guided proposals. Their steps are normal and lead to the end point; the weight is the
  density of the path under the target over its density under the proposal. There are three:
    - `modified_bridge` keeps drift and σ fixed at the current point;
    - `residual_bridge` subtracts a deterministic path first;
    - `linear_guide` uses the transition density of a linear process.
- `choice`: a separate proposal for each interval. `auto` collects the candidates, and `pilots`
  compares them by pilot runs.
- `memory_blocks`: paths drawn in blocks that fit in memory.

To add a proposal, add a module. To make it a candidate of "auto", name it in `auto`.
"""

# The names that other folders import from this one.
from .auto import (
    Budget as Budget,
    ProposalLike as ProposalLike,
    as_proposal as as_proposal,
    choice_between as choice_between,
    default_candidates as default_candidates,
    guided_candidates as guided_candidates,
    resolve as resolve,
    why_left_out as why_left_out,
)
from .base import (
    AbstractProposal as AbstractProposal,
    AbstractWeightedProposal as AbstractWeightedProposal,
    WeightedPaths as WeightedPaths,
)
from .choice import Choice as Choice, best_at_worst as best_at_worst
from .coupled import (
    CoupledPairs as CoupledPairs,
    as_pairs as as_pairs,
    check_density as check_density,
    pair_log_weights as pair_log_weights,
    usable as usable,
)
from .guided import (
    AbstractGuidedProposal as AbstractGuidedProposal,
    as_guided as as_guided,
    noise_of as noise_of,
    num_noises as num_noises,
    path_of as path_of,
)
from .linear_guide import Guided as Guided
from .modified_bridge import ModifiedDiffusionBridge as ModifiedDiffusionBridge
