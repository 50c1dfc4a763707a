"""The FitzHugh–Nagumo model of a neuron, with noise in the recovery variable only."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..engine.checks import Numbers, as_numbers, check_range
from .diffusion import Diffusion, check_dimension


class FitzHughNagumoParams(NamedTuple):
    """Parameters of `fitzhugh_nagumo`, the `params` of the model, shape () each.

    - `epsilon`: ratio of the time scale of the voltage to that of the recovery variable.
    - `gamma`, `beta`: per unit of time.
    - `sigma`: noise, per square root of a unit of time.

    **Example:**

    ```python
    model = jb.fitzhugh_nagumo()
    noisier = model.with_params(model.params._replace(sigma=jnp.asarray(0.4)))
    ```
    """

    epsilon: Float[Array, ""]
    gamma: Float[Array, ""]
    beta: Float[Array, ""]
    sigma: Float[Array, ""]


def fitzhugh_nagumo(
    epsilon: Numbers = 0.1, gamma: Numbers = 1.5, beta: Numbers = 0.8, sigma: Numbers = 0.3
) -> Diffusion:
    """Return the model of a spiking neuron (FitzHugh 1961; Nagumo, Arimoto & Yoshizawa 1962), in
    the form of Ditlevsen & Samson (2019).

    The state is (X, Y), voltage and recovery variable:

        dX = (X - X³ - Y) / ε dt,    dY = (γX - Y + β) dt + σ dW.

    The model is hypoelliptic: noise enters Y only. Bridges and transition densities do not apply;
    use `simulate`, or records with an `observation`. Time is in units of the relaxation time of Y;
    X and Y have no units. `params` is a `FitzHughNagumoParams`.

    **Arguments:** `epsilon`, ε > 0; `gamma`, γ; `beta`, β; `sigma`, σ ≥ 0: numbers, shape ().

    **Raises:** `ValueError` for other shapes or values.

    **Example:**

    ```python
    model = jb.fitzhugh_nagumo()
    model.diffusion(jnp.zeros(2))  # Array([[0. ], [0.3]], dtype=float32)
    ```
    """
    values = {"epsilon": epsilon, "gamma": gamma, "beta": beta, "sigma": sigma}
    params = FitzHughNagumoParams(**as_numbers(values))
    check_range("epsilon", params.epsilon, positive=True)
    check_range("gamma", params.gamma)
    check_range("beta", params.beta)
    check_range("sigma", params.sigma, nonnegative=True)
    return Diffusion(_drift, _sigma, params=params)


def _drift(x: Float[Array, " d"], p: FitzHughNagumoParams) -> Float[Array, " d"]:
    check_dimension(x, 2)
    voltage, recovery = x
    voltage_drift = (voltage - voltage**3 - recovery) / p.epsilon
    return jnp.stack([voltage_drift, p.gamma * voltage - recovery + p.beta])


def _sigma(x: Float[Array, " d"], p: FitzHughNagumoParams) -> Float[Array, "d m"]:
    # One column: one noise for two coordinates.
    return jnp.stack([jnp.zeros_like(p.sigma), p.sigma])[:, None]
