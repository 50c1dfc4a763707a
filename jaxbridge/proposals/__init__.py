"""Ways to propose bridges. A proposal is a path with an unbiased weight (`base`),

    E[w h(path)] = p_T(a, b) E_bridge[h],

and answers for itself: what it costs, what its bridges are exact for, what it must know before.
The pairs of a coupling have random weights (`coupled`). Paths that are pulled to the end point have
the density of their steps under the target over that under the proposal (`guided`): they are
pulled as if nothing changed on the way (`modified_bridge`), along a deterministic path
(`residual_bridge`), or by the transition density of a linear process (`linear_guide`). Each
interval may have its own (`choice`), found by pilot runs (`pilots`) between those that are given
(`auto`).

Another proposal is another file here; to be tried by "auto" it is named in `auto`.
"""

# What the folders above use of this one.
from .auto import (
    Budget as Budget,
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
    path_of as path_of,
)
from .linear_guide import Guided as Guided
from .modified_bridge import ModifiedDiffusionBridge as ModifiedDiffusionBridge
