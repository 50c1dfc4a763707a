"""Inference of parameters from discrete observations.

*Exact observations.* A diffusion with unknown parameters θ is observed at times t_0 < ... < t_n.
The likelihood is a product of transition densities, L(θ) = Π_k p_θ(x_{k-1}, x_k), which have no
closed form. Two facts replace them:

- With the bridges Z = (Z_1, ..., Z_n) between the observations the path is complete, and its
  density f_θ(Z) = Π_k f_θ(Z_k) has a closed form.
- A weighted proposal draws the paths of one interval with weights w, and E[w] = p_θ(x_{k-1}, x_k).

`parameters` binds a vector θ to a model, and `priors` gives it a law. `data` groups the intervals
by number of steps, and `blocks` selects a proposal for each group. The methods are:

- `gibbs`: data augmentation, π(θ, Z | x) ∝ π(θ) f_θ(Z) (`augmentation`). It draws the bridges given
  θ (`bridge_kernels`) and θ given the bridges (`parameter_kernels`) in turn.
- `pmmh`: Metropolis–Hastings on θ alone, with unbiased estimates of L(θ) (`likelihood_estimates`).
- `score`: Fisher's identity, ∇ log L(θ) = E[∇ log f_θ(Z) | x], and Louis's identity for the second
  derivatives.
- `maximum_likelihood`: an optimiser along the score, or EM with the step
  θ ← argmax E[log f_θ(Z) | x]. Both use new bridges in each iteration (`stochastic_approximation`).
  Newton's method follows (`newton`).

A complete path determines σ, so these methods do not apply to an unknown σ. For an unknown σ, and
by default for σ(x), `score` and `maximum_likelihood` differentiate Σ_k log p̂_θ(x_{k-1}, x_k) with
fixed noise. This sum is smooth in θ for guided proposals (`simulated_likelihood`). `gibbs` then
treats the observations as a record without noise.

*Records* with noisy, partial or missing observations. The likelihood is E[w(θ, ξ)], the mean weight
of paths that are functions of normal noise ξ (`record_paths`). `gibbs` samples from
π(θ) N(ξ; 0, I) w(θ, ξ) (`record_gibbs`), with a guide from the warm-up (`warm_up`). `pmmh` uses
particle filters (`likelihood_estimates`), and `maximum_likelihood` uses chains of paths
(`record_maximum`).

`posterior` contains the common parts of `gibbs` and `pmmh`: start, continuation and diagnostics of
chains. `parameter_walk` contains the random walks of θ, `population` parameters that vary between
records, and `checkpoint` runs that continue from a file.
"""
