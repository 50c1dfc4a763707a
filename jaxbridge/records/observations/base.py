"""Base of observation models: what guided paths need to know of the law of y_k given X(t_k).

Paths are guided by a normal law of linear functions of the state, as independent `Scalars`. Their
weights are then corrected by log g(y | x) minus the log density of these scalars.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from ...engine.arguments import as_returned, check_function, named
from ...engine.captured import Captured
from ...engine.checks import Numbers, as_floating, is_traced
from ...engine.linalg import dot
from ...models.tracing import takes_time


class Scalars(NamedTuple):
    """Independent scalar observations of one state x.

    Their law is `values` = `rows` x + N(0, diag(`variances`)). `seen` is false for missing scalars,
    which have row 0 and variance 1.
    """

    rows: Float[Array, "m d"]
    values: Float[Array, " m"]
    variances: Float[Array, " m"]
    seen: Bool[Array, " m"]


def missing_like(scalars: Scalars) -> Scalars:
    """Return scalars of the same shape, all missing."""
    return Scalars(
        jnp.zeros_like(scalars.rows),
        jnp.zeros_like(scalars.values),
        jnp.ones_like(scalars.variances),
        jnp.zeros_like(scalars.seen),
    )


class Row(NamedTuple):
    """Observation y at one time, NaN for missing components, and the time."""

    y: Float[Array, "m *lanes"]
    time: Float[Array, "*lanes"]


class AbstractObservation(eqx.Module):
    """Base class of observation models: the law g of an observation y, given the state x.

    Subclasses say how paths are guided (`scalars`), and correct their weights (`correction`). If
    the components of y are independent, each given a linear function of the state, it is easier to
    derive a model from `AbstractComponents`.

    - `matrix`: L, shape (m, d), of the linear functions that guide the paths; `None` for the state.

    **Example:**

    ```python
    isinstance(jb.LinearGaussian(covariance=0.1), jb.AbstractObservation)  # True
    ```
    """

    matrix: eqx.AbstractVar[Float[Array, "m d"] | None]

    @property
    @abstractmethod
    def depends_on_time(self) -> bool:
        """Whether the law of y given x depends on time."""

    @abstractmethod
    def check(
        self, values: Float[Array, "n m"], like: Array, time: Float[Array, ""], params: PyTree
    ) -> None:
        """Raise `ValueError` if this model does not fit the observations.

        - `values`: all observations, one row per time; NaN where a component is missing.
        - `like`: a point of the state space, shape (d,).
        - `time`: the time of an observation.
        - `params`: the parameters of the model.
        """

    @abstractmethod
    def scalars(self, row: Row, params: PyTree, d: int) -> Scalars:
        """Return independent normal scalars, linear in x, whose law is like that of y given x."""

    @abstractmethod
    def sample(
        self,
        key: Key[Array, ""],
        x: Float[Array, " d"],
        params: PyTree = None,
        time: Numbers = 0.0,
    ) -> Float[Array, " m"]:
        """Draw an observation, given the state x and the model's parameters.

        **Raises:** `TypeError` if the model cannot (`check_sample`).
        """

    @abstractmethod
    def check_sample(self) -> None:
        """Raise `TypeError` if `sample` is not available."""

    @abstractmethod
    def correction(self, row: Row, x: Float[Array, " d"], params: PyTree) -> Float[Array, ""]:
        """Return log g(y | x) minus the log density of `scalars`; zero if no component is seen."""


class Quantity(eqx.Module):
    """Numbers of an observation model, or a function of the model's parameters (and time).

    **Arguments:**

    - `name`: the name in errors.
    - `value`: numbers, or a function `params -> numbers` or `(params, t) -> numbers`.

    **Raises:** `TypeError` for anything but numbers or such a function; `ValueError` for NaN.

    **Example:**

    ```python
    scale = jb.Quantity("scale", lambda params: jnp.exp(params.log_scale))
    ```
    """

    name: str = eqx.field(static=True)
    value: Float[Array, "..."] | None
    _function: Callable | None = eqx.field(static=True)
    _captured: Captured

    def __init__(self, name: str, value: Numbers | Callable[..., Array]):
        self.name = name
        if callable(value):
            check_function(name, value, "(params)", "(params, t)")
        self._function = value if callable(value) else None
        self._captured = Captured(self._function)
        self.value = None if callable(value) else as_floating(name, value)
        if self.value is not None and not is_traced(self.value) and np.any(np.isnan(self.value)):
            raise ValueError(f"`{name}` must be a number; got {np.asarray(self.value)}.")

    @property
    def depends_on_time(self) -> bool:
        """Return whether the numbers depend on time."""
        return takes_time(self._function, 1)

    def at(self, params: PyTree, time: Float[Array, "..."]) -> Float[Array, "..."]:
        """Return the numbers at these parameters and this time, in the dtype of `time`."""
        value = self.value
        if self._function is not None:
            arguments = (params, time) if self.depends_on_time else (params,)
            value = named(self.name, self._captured.call)(self._function, *arguments)
            value = as_returned(self.name, value)
        assert value is not None
        return value.astype(time.dtype)

    def for_components(self, params: PyTree, time: Float[Array, ""], m: int) -> Float[Array, " m"]:
        """Return one number for each of m components.

        **Raises:** `ValueError` for numbers of another shape than () or (m,).
        """
        value = self.at(params, time)
        if value.shape not in ((), (m,)):
            raise ValueError(
                f"`{self.name}` must have shape () or ({m},) for observations of {m} components; "
                f"got shape {value.shape}. For one value per time pass a function `(params, t)`."
            )
        return jnp.broadcast_to(value, (m,))


def as_matrix(matrix: Numbers | None) -> Float[Array, "m d"] | None:
    """Return L as floating point numbers, or `None`.

    **Raises:** `ValueError` for another shape than (m, d), or numbers that are not finite.
    """
    if matrix is None:
        return None
    numbers = as_floating("matrix", matrix)
    if numbers.ndim != 2:
        raise ValueError(f"`matrix` must have shape (m, d); got shape {numbers.shape}.")
    if not is_traced(numbers) and not np.all(np.isfinite(numbers)):
        raise ValueError(f"`matrix` must be finite; got {numbers}.")
    return numbers


def matrix_for(matrix: Float[Array, "m d"] | None, d: int, dtype) -> Float[Array, "m d"]:
    """Return L as a matrix, shape (m, d): the identity for `None`."""
    # NumPy's identity needs no compiled program.
    return jnp.asarray(np.eye(d, dtype=dtype)) if matrix is None else matrix.astype(dtype)


def check_matrix(matrix: Float[Array, "m d"] | None, m: int, like: Float[Array, " d"]) -> None:
    """Raise `ValueError` if L does not fit observations of m components and the state space."""
    (d,) = like.shape
    rows = d if matrix is None else matrix.shape[0]
    if matrix is not None and matrix.shape[1] != d:
        raise ValueError(
            f"`matrix` must have shape (m, {d}) for a state of {d} dimensions; got shape "
            f"{matrix.shape}."
        )
    if rows != m:
        raise ValueError(
            f"`observations` have {m} components, but the observation model has {rows}: as many "
            "as `matrix` has rows, or the whole state without a `matrix`. Pass a `matrix` of "
            f"shape ({m}, {d})."
        )


def log_density_of(scalars: Scalars, x: Float[Array, " d"]) -> Float[Array, ""]:
    """Return the log density of the scalar observations, given x."""
    total = jnp.zeros((), x.dtype)
    for row, value, variance, present in zip(*scalars, strict=True):
        residual = value - dot(row, x)
        terms = residual**2 / variance + jnp.log(2 * np.pi * variance)
        total -= jnp.where(present, terms, 0) / 2
    return total


def check_observation(observation) -> None:
    """Raise `TypeError` for anything but an observation model."""
    if not isinstance(observation, AbstractObservation):
        raise TypeError(
            "`observation` must be a `LinearGaussian`, an `ObservationDensity` or another "
            f"`AbstractObservation`; got {observation!r}."
        )
