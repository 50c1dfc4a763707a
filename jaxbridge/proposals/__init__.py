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
