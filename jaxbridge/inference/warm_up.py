"""Stages of the warm-up of chains with guided paths, at which the guide is replaced.

The start of a chain may be far from likely parameters. Then the path of the linearisation and its
guide are poor: weights vary much, and blocks rarely move. Hence each stage of the warm-up finds a
new path at the current θ of the first chain.
"""

# After these shares of the warm-up.
_ANEW = (1 / 8, 1 / 4, 1 / 2)


def stages(num_warmup: int, num_in_all: int) -> list[int]:
    """Where the stages of so many steps end, of which the first `num_warmup` are a warm-up."""
    anew = {round(share * num_warmup) for share in _ANEW} - {0}
    return [*sorted(anew), num_in_all]
