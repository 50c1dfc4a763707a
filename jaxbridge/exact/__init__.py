"""What is made of weights, on any proposal: bridges of the exact law (`exact_bridges`),

    E_bridge[h] = E[w h(path)] / E[w],    p_T(a, b) = E[w],

by importance sampling (`importance`) and by Markov chains (`chains`), which are kernels as well
(`kernels`): `pseudo_marginal`, `renewal` and `crank_nicolson`, a method a module. Transition
densities are means of weights (`density`), and `expectation` has derivatives that are right.
"""
