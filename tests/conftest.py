"""Every test runs with strict promotion of dtypes and warnings as errors; those of the whole
package that run by default, refusals and examples among them, with its annotations checked."""

import gc
import os
import pathlib
import platform
import re
import shutil
import sys
import time
import zlib
from importlib import metadata

from jaxtyping import config as jaxtyping_config, install_import_hook
from packaging.version import Version  # which pytest installs

# Tests compile for longer than they run, and so as `engine.compiled_sooner` does, what they write
# themselves, too, and without the optimisation that is faulty in some releases (`engine.compiler`).
# Programs of their own (`helpers.run_program`, the command line) are as users'.
_FLAGS = [
    "--xla_cpu_parallel_codegen_split_count=1",  # workers share the cores
    "--xla_disable_hlo_passes=small-while-loop-hoisting",
]
if Version(metadata.version("jaxlib")) < Version("0.11.1"):  # later ones end at unknown flags
    _FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(_FLAGS))
# Workers share the cores: threads of linear algebra that wait for each other cost up to ten times
# the time of one. NumPy and SciPy read this when they are imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Traces are millions of objects, few of which are garbage; a search for it looks at all of them.
gc.set_threshold(50_000, 10, 10)

import jax  # noqa: E402
import pytest  # noqa: E402

jax.config.update("jax_numpy_dtype_promotion", "strict")
_TESTS = pathlib.Path(__file__).parent

# Modules, workers, the programs that tests start, and later runs compile mostly the same programs.
# They are kept, however small, for this release of jaxlib and this kind of processor, in pytest's
# own cache folder (`-o cache_dir=FOLDER`); `pytest --cache-clear` removes them.
_MOST_BYTES = 4_000_000_000
_CACHE = "JAX_COMPILATION_CACHE_DIR"


def _processor() -> str:
    """Return a name of this kind of processor, on whose instructions programs depend."""
    about = pathlib.Path("/proc/cpuinfo")
    flags = re.search(r"^flags.*$", about.read_text(), re.M) if about.exists() else None
    name = flags[0] if flags else platform.processor()
    return f"{platform.machine()}-{zlib.crc32(name.encode()):08x}"


def _programs(config: pytest.Config) -> pathlib.Path:
    """Return the folder of compiled programs, emptied if it has grown large."""
    release = f"jaxlib-{metadata.version('jaxlib')}-{_processor()}"
    folder = config.cache.mkdir("programs") / release
    if folder.exists() and sum(file.stat().st_size for file in folder.iterdir()) > _MOST_BYTES:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def pytest_collection_finish() -> None:
    # What is there before the first test stays: searches for garbage need not look at it.
    gc.freeze()


def pytest_configure(config: pytest.Config) -> None:
    # Slow tests run without the check of annotations, and so without the hook: it takes time even
    # where nothing is checked.
    if config.option.markexpr != "slow":
        install_import_hook("jaxbridge", "annotations.check_annotations")
    # Workers inherit the folder from the process that starts them.
    if _CACHE not in os.environ and config.pluginmanager.hasplugin("cacheprovider"):
        os.environ[_CACHE] = str(_programs(config))
    jax.config.update("jax_compilation_cache_dir", os.environ.get(_CACHE))


jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
jax.config.update("jax_disable_most_optimizations", True)  # of what is made while collecting


# Processor time (s) of a test whose programs are not compiled yet: about twice what the longest
# tests take.
_MOST_SECONDS, _MOST_SECONDS_SLOW = 30, 900


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    """Fail tests that take too much processor time, which is the same on a busy machine."""
    start = time.process_time()
    result = yield
    seconds = time.process_time() - start
    if "slow" in item.keywords:
        most, advice = _MOST_SECONDS_SLOW, "Make it cheaper, or split it."
    else:
        most, advice = _MOST_SECONDS, "Make it cheaper, or mark it as `slow`."
    if seconds > most:
        message = f"The test took {seconds:.0f} s of processor time; at most {most} s are allowed."
        pytest.fail(f"{message} {advice}", pytrace=False)
    return result


@pytest.fixture(autouse=True)
def compiled_in_haste(request):
    """Most of the time of tests goes into compilation, of which optimisation is half. Tests marked
    as `optimised`, which run for longer, are optimised as for users, as what `helpers.run_program`
    runs is."""
    haste = "optimised" not in request.keywords
    jax.config.update("jax_disable_most_optimizations", haste)


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


@pytest.fixture(autouse=True)
def checked_by_default(request):
    """Annotations are checked in what runs by default through the public functions, where they
    reach everything: it takes a sixth of the time."""
    if "slow" in request.keywords or request.path.parent != _TESTS:
        request.getfixturevalue("unchecked")


@pytest.fixture(autouse=True)
def few_compiled_programs_stay():
    """Compiled programs hold memory, and maps of it, of which a process may have 65,530 on Linux: a
    suite of some thousand programs would run out of them, and the compiler would crash."""
    yield
    maps = pathlib.Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > 10_000:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def figures_end_with_the_test():
    """Whichever worker drew what, no test finds the figures of others open."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
