"""One step, x' = step(x, ΔW) with ΔW ~ N(0, δ I): made, inverted, and its density.

A scheme (`base`) makes the step, says which noise made it, ΔW = noise(x, x'), and how a pair of
points lies for that noise, by the direction u and the length of σ(x')⁻¹(x - x') (`frame`). Schemes
are `euler` and `milstein`, `heun` of second order for constant σ, `semi_implicit` for stiff drift,
and for a linear one its own transition (`gaussian_transition`); whether scheme, model and points
fit is checked (`fit`). The density of a step, N(μ(x), δ σ S σᵀ) (`step_density`), makes the
likelihood of a path, Σ log q(x_i, x_{i+1}) (`path_likelihood`). The same of every other point says
what half as many steps would give (`halving`), and so how far N steps are from the limit
(`step_error`).
"""
