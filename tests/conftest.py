"""Every test runs with the package's annotations checked at run time, strict promotion of
dtypes and warnings as errors."""

import os
import shutil
import sys
import tempfile

from jaxtyping import config as jaxtyping_config, install_import_hook

# Nearly all of the time goes into compilation, of which optimisation is two thirds. What
# `helpers.run_program` runs is compiled as it is for users. (A release of XLA that no longer knows
# a flag stops: then `XLA_FLAGS= pytest`.)
os.environ.setdefault(
    "XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false"
)
install_import_hook("jaxbridge", "beartype.beartype")

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")

# Modules, workers and the programs that tests start compile much the same: what one has
# compiled the others read from disk, for the time of one run.
_CACHE = "JAX_COMPILATION_CACHE_DIR"
_OWNS_CACHE = _CACHE not in os.environ
if _OWNS_CACHE:
    os.environ[_CACHE] = tempfile.mkdtemp()
jax.config.update("jax_compilation_cache_dir", os.environ[_CACHE])


def pytest_unconfigure():
    if _OWNS_CACHE:
        shutil.rmtree(os.environ[_CACHE], ignore_errors=True)


@pytest.fixture(params=["float32", pytest.param("float64", marks=pytest.mark.slow)])
def precision(request):
    """Run a test in both precisions, in double among the slow ones."""
    with jax.enable_x64(request.param == "float64"):
        yield request.param


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


@pytest.fixture
def unchecked():
    """Without the check of annotations, as users run the package."""
    jaxtyping_config.update("jaxtyping_disable", True)
    yield
    jaxtyping_config.update("jaxtyping_disable", False)


@pytest.fixture(autouse=True, scope="module")
def compiled_programs_end_with_the_module():
    """Compiled programs hold memory maps, of which a process may have 65,530 on Linux: a suite of
    some thousand programs would run out of them, and the compiler would crash."""
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def figures_end_with_the_test():
    """Whichever worker drew what, no test finds the figures of others open."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
