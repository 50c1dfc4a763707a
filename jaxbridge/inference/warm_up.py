"""Stages of the warm-up of chains with guided paths, at which the guide is replaced.

The first θ of a chain may be unlikely. Then the path of linearisation and its guide are poor:
weights vary much, and blocks rarely move. Hence each stage of the warm-up computes a new path at
the current θ of the first chain.
"""

# Stages begin after these fractions of the warm-up.
_ANEW = (1 / 8, 1 / 4, 1 / 2)


def stages(num_warmup: int, num_in_all: int) -> list[int]:
    """Return the ends of the stages of `num_in_all` steps; the first `num_warmup` are warm-up."""
    anew = {round(share * num_warmup) for share in _ANEW} - {0}
    return [*sorted(anew), num_in_all]
