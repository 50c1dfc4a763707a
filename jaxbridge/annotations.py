"""Names for annotations."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import ArrayLike

# Anything `jnp.asarray` takes: an array, a number, a (nested) list of numbers.
Numbers = ArrayLike | Sequence[Any]
