"""Compile the kernels of `track` and keep them, so that later runs find them."""

from functools import partial
from operator import call
from typing import Any

from stereophd.core.multi.build import prepare
from stereophd.core.multi.filter_settings import filters
from stereophd.core.numerics.compilation.kernel_cache import place_to_keep
from stereophd.errors import InputError
from stereophd.pipeline.workers.places import on_processes
from stereophd.wording import LOGGER


def compile_kernels(jobs: int = 1) -> dict[str, Any]:
    """Compile the kernels of all filters for many objects, in `jobs` processes, where they are not kept already.

    Returns ``folder``, where new kernels are kept, and ``filters``, their names; InputError if no folder can be
    written.
    """
    place = place_to_keep()
    if place is None:
        raise InputError("compiled kernels: expected a folder that can be written to; set NUMBA_CACHE_DIR to one")
    kinds = sorted(filters())
    # of each filter, two processes compile from both ends
    tasks = [partial(prepare, kind, last_first) for kind in kinds for last_first in (False, True)]
    for _ in map(prepare, kinds) if jobs == 1 else on_processes(call, tasks, jobs):
        pass
    LOGGER.info("kernels of %s: kept in %s", ", ".join(kinds), place)
    return {"folder": str(place), "filters": kinds}
