"""Long runs in parts, with a file from which an interrupted run continues.

A run has at most ten parts. Each one continues the state of the previous one with the same key, so
the draws depend on the parts but not on interruptions. After each part a file receives all draws so
far; it is replaced as a whole, so it is complete whenever the process ends. A resumed run repeats
the first part. This restores the parts of a result that no file can hold, such as functions, and
shows that the model, the data and the key are those of the file.
"""

import functools
import inspect
import logging
import os
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..engine.checks import check_count, is_traced
from .posterior import AbstractPosterior

_NUM_PARTS = 10
# R̂ needs so many draws.
_FEWEST_DRAWS = 4
_LOGGER = logging.getLogger("jaxbridge")

_Arguments = ParamSpec("_Arguments")
_Posterior = TypeVar("_Posterior", bound=AbstractPosterior)


def resumable(sample: Callable[_Arguments, _Posterior]) -> Callable[_Arguments, _Posterior]:
    """Decorate a sampler: with a `checkpoint` it runs in parts, and continues an earlier run."""

    @functools.wraps(sample)
    def entered(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Posterior:
        checkpoint: Any = kwargs.pop("checkpoint", None)
        if checkpoint is None:
            return sample(*args, **kwargs)
        call = inspect.signature(sample).bind(*args, **kwargs)
        call.apply_defaults()
        return _run_in_parts(sample, call.arguments, _as_path(checkpoint, call.arguments))

    return entered


def _as_path(checkpoint: Any, arguments: dict[str, Any]) -> Path:
    """Return the path of the file, or raise for arguments with which no file can be written."""
    if not isinstance(checkpoint, str | os.PathLike):
        raise TypeError(
            f"`checkpoint` must be the path of a file, for instance 'run.npz'; got {checkpoint!r}."
        )
    if is_traced(*arguments.values()):
        raise ValueError(
            "`checkpoint` writes a file, which compiled code cannot do: call the function outside "
            "`jit` and `vmap`, or leave out `checkpoint`."
        )
    path = Path(os.fspath(checkpoint))
    if path.is_dir() or not path.absolute().parent.is_dir():
        raise ValueError(
            "`checkpoint` must be the path of a file, new or from an earlier run, in an existing "
            f"folder; got {str(path)!r}. Create the folder, or add the name of a file."
        )
    return path


def _run_in_parts(
    sample: Callable[..., _Posterior], arguments: dict[str, Any], path: Path
) -> _Posterior:
    """Run all parts that the file does not contain; return the draws of all parts."""
    positional = {name: arguments.pop(name) for name in ("key", "model", "times", "observations")}
    del arguments["checkpoint"]
    sizes = _sizes(check_count("num_iterations", arguments["num_iterations"]))
    call = functools.partial(sample, *positional.values())
    begin = time.monotonic()
    posterior, num_done = call(**arguments | {"num_iterations": sizes[0]}), 1
    if path.exists():
        posterior, num_done = _load(path, posterior, sizes)
    else:
        _save(path, posterior, num_done)
    _report(posterior, num_done, len(sizes), begin, 1)
    continuation = posterior.continuation
    if getattr(posterior.state, "proposals", ()) and arguments["proposal"] == "auto":
        # The proposals of the state were chosen with these budgets, and keep them.
        continuation |= {"num_counts": None, "max_trials": None}
    for number in range(num_done, len(sizes)):
        continuation |= {"init": posterior.state, "num_iterations": sizes[number]}
        posterior = posterior.joined(call(**arguments | continuation))
        _save(path, posterior, number + 1)
        _report(posterior, number + 1, len(sizes), begin, number + 2 - num_done)
    return posterior


def _sizes(num_iterations: int) -> list[int]:
    """Return the numbers of draws of the parts: equal ones, which share a compiled program."""
    size = -(-num_iterations // _NUM_PARTS)
    return [min(size, num_iterations - begin) for begin in range(0, num_iterations, size)]


def _save(path: Path, posterior: AbstractPosterior, num_done: int) -> None:
    """Replace the file by one with these draws."""
    leaves = jax.tree.leaves(eqx.filter(posterior, eqx.is_array))
    arrays: dict[str, Any] = {_name(number): np.asarray(leaf) for number, leaf in enumerate(leaves)}
    arrays["num_done"] = np.asarray(num_done)
    # In the same folder, because a file can be replaced at once only within a file system. Always
    # the same name: what a killed process leaves is overwritten.
    partial = path.with_name(f"{path.name}.tmp")
    try:
        with partial.open("wb") as file:
            np.savez(file, **arrays)
        os.replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _load(path: Path, first: _Posterior, sizes: list[int]) -> tuple[_Posterior, int]:
    """Return the draws in the file, and the number of its completed parts.

    `first` holds the draws of the first part, and `sizes` the numbers of draws of all parts.

    **Raises:** `ValueError` for a damaged file, or one that does not begin with `first`.
    """
    arrays, others = eqx.partition(first, eqx.is_array)
    leaves, treedef = jax.tree.flatten(arrays)
    try:
        # NumPy does not close a damaged file that it opened itself.
        with path.open("rb") as file, np.load(file) as arrays_in_file:
            num_done = int(arrays_in_file["num_done"])
            saved = [jnp.asarray(arrays_in_file[_name(i)]) for i in range(len(leaves))]
    except (KeyError, OSError, ValueError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"`checkpoint`: {str(path)!r} is not a file of such a run. Pass the path of a new file."
        ) from error
    posterior = eqx.combine(jax.tree.unflatten(treedef, saved), others)
    begins_alike = np.array_equal(posterior.theta[..., : sizes[0], :], first.theta)
    if not begins_alike or posterior.theta.shape[-2] != sum(sizes[:num_done]):
        raise ValueError(
            f"`checkpoint`: the file {str(path)!r} does not begin with the draws of this call. "
            "Pass the arguments of the run that wrote it, on the same machine and versions, or the "
            "path of a new file."
        )
    return posterior, num_done


def _name(number: int) -> str:
    """Return the name of an array in the file."""
    return f"leaf{number}"


def _report(
    posterior: AbstractPosterior, num_done: int, num_parts: int, begin: float, num_run: int
) -> None:
    """Log R̂, the effective sample size and the remaining time."""
    too_few = posterior.theta.shape[-2] < _FEWEST_DRAWS
    if too_few or not _LOGGER.isEnabledFor(logging.INFO):
        return
    remaining = (time.monotonic() - begin) / num_run * (num_parts - num_done)
    _LOGGER.info(
        "part %d of %d: largest R̂ %.3f, fewest effective draws %.0f, about %.0f s left",
        num_done,
        num_parts,
        float(jnp.max(posterior.r_hat)),
        float(jnp.min(posterior.effective_sample_size)),
        remaining,
    )
