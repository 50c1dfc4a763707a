"""What diffuses: dX = α(X) dt + σ(X) dW, stationary with density ν, and its time reversal

    dX* = α*(X*) dt + σ(X*) dW,    α* = -α + V ∇log ν + div V,    V = σσᵀ.

σ at a point is one of six operators (`sigma`); with a drift it makes the coefficients of an
equation (`dynamics`). A model (`diffusion`) is made of functions and parameters: it is seen what
these depend on (`tracing`), and decided what need be simulated (`decisions`). Some are at hand:
those of a given ν (`langevin`), `hyperbolic`, and `ornstein_uhlenbeck` with its stationary law
(`gaussian_law`), its transitions (`linear`, for any linear drift) and its bridges
(`gaussian_bridge`). The same model in other coordinates, Y = f(X), has Itô's drift
∇f α + ½ Σ_k ∂²f(σ_k, σ_k) (`transform`); where Y = ∫ du/σ(u) its σ is one (`lamperti`). Noise
reaches only a part of the state of `fitzhugh_nagumo`, of `underdamped_langevin`, and of a model
`integrated` over time; and that of a `seasonal` one depends on time. Paths that are free at their
end are simulated (`simulate`); of bridges the end points and durations are given, on a grid of
times (`bridge_problem`).
"""
