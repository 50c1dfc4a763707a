"""The warm-up of chains that are guided through a record, in stages.

Where chains start θ may be far off, and then the path along which the process is linearised is,
and the guide with it: weights vary too much, blocks hardly move. So the path is found anew, at
the θ where the first chain is, while there still is a warm-up to go.
"""

# After these shares of the warm-up.
_ANEW = (1 / 8, 1 / 4, 1 / 2)


def stages(num_warmup: int, num_in_all: int) -> list[int]:
    """Where the stages of so many steps end, of which the first `num_warmup` are a warm-up."""
    anew = {round(share * num_warmup) for share in _ANEW} - {0}
    return [*sorted(anew), num_in_all]
