"""How programs run. Nothing here knows of diffusions.

What is given becomes arrays, or an error that says what to change (`checks`). A random number is a
function of its place in a tree of keys (`keys`), so nothing depends on what runs beside it. Points
are small and lanes, one simulated path each, are many: a function of one point is evaluated with
lanes in the last axis (`lanes`, whose values have one of the `lane_forms`), its algebra written
out (`linalg`), in scans over time that draw their noise chunk by chunk (`noise`), or, where there
is but one path, have the derivatives of all steps at once (`recursion`). Attempts are made side by
side until each of many problems has its successes (`rejection`), on all `devices`, in loops that
tell how far they are (`progress`).

Of what comes out means are taken, Σ w h / Σ w (`averages`), whose weights have tails that allow it
or not (`pareto`), and whose draws are worth so many independent ones (`diagnostics`). What is
missing is a fault of the result, and an error at run time for those who ask for it (`verdict`). A
process that has compiled more than it can hold is warned (`memory_maps`).
"""
