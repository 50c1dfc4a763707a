"""Models of diffusions: `dX = α(X) dt + σ(X) dW` with stationary density ν, and its time reversal

    dX* = α*(X*) dt + σ(X*) dW,    α* = -α + V ∇log ν + div V,    V = σσᵀ.

Parts of a model:

- `sigma`: σ at one point, as one of six linear operators.
- `dynamics`: the drift and σ of one equation, ready for compiled loops.
- `tracing`: traces of a model's functions, and tests of which arguments they use.
- `decisions`: the rules that select the effects to simulate.
- `diffusion`: the model, which combines functions and parameters.

Ready models:

- `langevin`: diffusions with a given stationary density.
- `hyperbolic`: the hyperbolic diffusion.
- `ornstein_uhlenbeck`: linear models, with their stationary law (`gaussian_law`), transitions
    (`linear`, for every linear drift) and bridges (`gaussian_bridge`).
- `seasonal`: a model whose coefficients depend on time.
- `fitzhugh_nagumo`, `underdamped_langevin`, `integrated`: hypoelliptic models, in which noise
    enters only some coordinates.

Changes of coordinates Y = f(X):

- `transform`: any smooth bijection f. By Itô's formula Y has the drift ∇f α + ½ Σ_k ∂²f(σ_k, σ_k).
- `lamperti`: in one dimension, Y = ∫ du/σ(u), which has σ = 1.

Paths:

- `simulate`: unconditional paths.
- `jumps`: jumps of the state at known times.
- `windings`: points with the same angles, for circles and tori.
- `bridge_problem`: the end points, durations and time grid of bridges.
"""
