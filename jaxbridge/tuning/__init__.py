"""Choices by pilot runs, and measurements of accuracy against computing time.

- `start_law`: choose γ and the start law of a coupling.
- `choose_proposal`: choose the fastest proposal for each interval.
- `work_precision`, with `measurement` and `settings`: measure error and computing time, and select
  the cheapest setting for a required accuracy.
- `hitting_variation`: estimate how much the hitting probability varies over exact bridges. This
  variation makes the weights of coupled bridges unequal.

All choices run outside `jit`, because they inspect numbers or time programs. The sampling
functions do not depend on this folder.
"""
