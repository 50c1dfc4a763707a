"""Parameters from discrete observations.

A diffusion with unknown parameters θ is seen at times t_0 < ... < t_n only. The likelihood of what
was seen is a product of transition densities, L(θ) = Π_k p_θ(x_{k-1}, x_k), which are not known;
but with the bridges Z = (Z_1, ..., Z_n) between the observations the path is complete, and its
density f_θ(Z) = Π_k f_θ(Z_k) is. A weighted proposal makes bridges of one interval from paths with
weights w, whose mean E[w] = p_θ(x_{k-1}, x_k) is a density, too.

A vector θ is bound to a model (`parameters`) and has a law (`priors`). Observations are intervals,
in groups of one number of steps, and with the parameters make a problem (`data`). Each group gets a
proposal that suits its use (`blocks`). On these are built:

* data augmentation, π(θ, Z | x) ∝ π(θ) f_θ(Z) (`augmentation`), drawn from by blocks in turn: the
  bridges given θ (`bridge_kernels`), and θ given the bridges (`parameter_kernels`): `gibbs`;
* Metropolis–Hastings on θ alone, with an unbiased estimate of L(θ) in its place: `pmmh`. Draws of
  both have errors, by their number and by the steps, and chains that start and go on (`posterior`);
* Fisher's identity, ∇ log L(θ) = E[∇ log f_θ(Z) | x], and Louis's for the second derivatives:
  `score`; along it climb optimisers and EM, θ ← argmax E[log f_θ(Z) | x], with new bridges in each
  iteration (`stochastic_approximation`);
* the maximum of Σ_k log p̂_θ(x_{k-1}, x_k) with fixed noise, smooth in θ where proposals are pulled
  to the end point (`simulated_likelihood`): for parameters of σ, which a whole path gives away.
  Either way it is `maximum_likelihood`.

Of records that were seen with noise or in part the likelihood is E[w(θ, ξ)], the mean weight of
paths that normal noise ξ makes (`record_paths`). Draws from π(θ) N(ξ; 0, I) w(θ, ξ) are `gibbs` as
well (`record_gibbs`), with a guide found anew in the warm-up (`warm_up`), and the maximum is
`maximum_likelihood` (`record_maximum`). What `pmmh` needs of L(θ), of either kind, is in
`likelihood_estimates`.
"""
