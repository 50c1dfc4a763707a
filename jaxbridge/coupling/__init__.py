"""Bridges from a to b by coupling: two diffusions that meet are one from then on.

A coupling drives X' by the noise of X, and X by that of X' (`base`; `gamma`),

    dW' = {I - (1-γ)Π} O dW + √(1-γ²) u dU,    Π = uuᵀ,

with u along σ(x')⁻¹(x - x') and O a `rotation` that aligns σ(x) and σ(x'), until a rule says that
they have met (`meeting`): one step of a `pair`. With X run back from b and X' from a, joined where
they meet, Z = X' before and X after is a proposed bridge (`join`), and those that met are kept
(`bridges`). They have the density f_br(z) π(z) / π, π(z) the probability that the diffusion
associated with z (`associated`), which starts from ν or another law (`start_laws`, for which it may
have to be known when the past is forgotten: `burn_in`), hits z; it is counted how many it takes
(`hitting`). `effects` is a table of what such a program simulates, and why.
"""
