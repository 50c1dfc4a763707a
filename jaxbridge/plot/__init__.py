"""Pictures of bridges, of their law against an exact law, of posteriors and of work–precision.

Each function draws in the axes `ax`, or creates new axes, and returns the axes. The module is
separate because it needs Matplotlib: install the extra `plot`.

```python
from jaxbridge import plot
```
"""

from .pictures import (
    bridge_fan,
    copula_levels,
    paths_in_space,
    posterior,
    qq,
    trace,
    work_precision,
)

__all__ = [
    "paths_in_space",
    "bridge_fan",
    "qq",
    "copula_levels",
    "work_precision",
    "posterior",
    "trace",
]
