"""Compilation, validation and numerical building blocks, independent of diffusions.

Input and errors:

- `checks` validates arrays, keys and counts; `arguments` validates functions and flags; `times`
  validates times.
- `indices` reports array indices that are out of bounds, which JAX would clamp.
- `verdict` collects the faults of a result and raises them at run time on request.

Random numbers and lanes:

- `keys` derives each key from its place in a tree. No result depends on the batch that computes it.
  `generator` provides a faster threefry.
- `lanes` evaluates a function of one point for many simulated paths ("lanes"), with lanes in the
  last axis. `lane_forms` stores the values, `linalg` provides the algebra.
- `noise` scans over time and draws the noise in chunks of steps. `recursion` differentiates all
  steps of one path at once.
- `rejection` runs attempts for many problems side by side until each problem has its successes.
- `devices` splits lanes over devices, `batch_size` chooses their number, `progress` adds progress
  meters to loops, and `interrupt` lets such loops end after Ctrl-C.

Compilation:

- `entry` wraps public functions; `compiled` and `compiler` compile; `captured` handles closures
  over traced values; `memory_maps` warns before compiled programs exhaust the memory.

Statistics:

- `averages` computes weighted means Σ w h / Σ w, `pareto` the tail shape k̂ of weights,
  `diagnostics` effective sample sizes and R̂ of chains.
"""
