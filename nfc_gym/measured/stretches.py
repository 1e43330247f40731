"""A log with gaps in its time, cut into the stretches between them (`time.gaps: cut`)."""

import itertools
from collections.abc import Iterator
from dataclasses import replace

from nfc_gym.core import InputError, Log
from nfc_gym.measured.log_time import gaps
from nfc_gym.measured.mapping import Mapping
from nfc_gym.measured.splits import Source

_ROWS = 4  # of the shortest stretch that a mode which takes instants can use: their rates are differences


def stretches(mapping: Mapping, source: Source, log: Log) -> Iterator[tuple[Source, Log]]:
    """The log itself where it has no gap, else its stretches as logs named `<log>/1`, `<log>/2`, ... from 1.

    What drove the machine across a gap is not known: a stretch knows nothing of what came before it. One that is
    shorter than a segment is of no use and left out; its number is, too.

    Raises:
      InputError: no stretch is long enough.
    """
    found = gaps(log.time)
    if not len(found):
        yield source, log
        return
    least = mapping.segments.length if mapping.segments.mode == "rollout" else 0.0
    edges, used = [0, *(found + 1).tolist(), len(log)], 0
    for number, (start, stop) in enumerate(itertools.pairwise(edges), 1):
        if stop - start >= _ROWS and log.time[stop - 1] - log.time[start] >= least - 0.5 * log.interval:
            name, used = f"{log.name}/{number}", used + 1
            yield replace(source, name=name), replace(log.part(start, stop, name), before=None)
    if not used:
        raise InputError(
            f"none of the {len(edges) - 1} stretches between its gaps is as long as a segment, {least:g} s; "
            "shorten segments.length"
        )
