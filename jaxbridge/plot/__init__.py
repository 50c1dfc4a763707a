"""Pictures of bridges, of their law beside an exact one, and of what is inferred by them. Each
function takes the axes to draw in, `ax`, or makes them, and returns them. Needs the extra `plot`.

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
