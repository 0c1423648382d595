"""No two purposes draw from one stream, and every key stands in the table."""

from __future__ import annotations

import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from stereophd.core.numerics import random_streams
from stereophd.core.numerics.random_streams import FIRST_KEY, Purpose, RunPurpose, run_number

PURPOSES = {name: value for name, value in vars(random_streams).items() if isinstance(value, Purpose)}
RUN_PURPOSES = {name: value for name, value in vars(random_streams).items() if isinstance(value, RunPurpose)}
PACKAGE = Path(random_streams.__file__).parents[2]


def test_no_path_repeats() -> None:
    assert len(PURPOSES) >= 9
    assert len(RUN_PURPOSES) >= 5
    for table in (PURPOSES, RUN_PURPOSES):
        for (name, one), (other_name, other) in combinations(table.items(), 2):
            assert one.path != other.path, f"{name} and {other_name} share the path {one.path}"
    # runs count from 0 and never reach the first key, so the two tables cannot meet
    assert all(purpose.path[0] >= FIRST_KEY for purpose in PURPOSES.values())


@pytest.mark.parametrize("name", RUN_PURPOSES)
def test_a_path_is_that_of_spawned_seeds(name: str) -> None:
    """`simulate --runs N` may spawn its runs: run k is the same for every number of runs."""
    seed = np.random.SeedSequence(7).spawn(4)[3]
    for key in RUN_PURPOSES[name].path:
        seed = seed.spawn(key + 1)[key]
    expected = seed.generate_state(4)
    np.testing.assert_array_equal(RUN_PURPOSES[name].seed(7, 3).generate_state(4), expected)
    if not RUN_PURPOSES[name].path:
        assert run_number(7, 3) == int(seed.generate_state(1, np.uint64)[0] >> 1)


def test_keys_stand_in_the_table_only() -> None:
    """Nothing else derives a stream from the seed of a configuration by a key of its own, or has a fixed seed."""
    found = [
        f"{path.relative_to(PACKAGE)}: {line.strip()}"
        for path in PACKAGE.rglob("*.py")
        if path.name != "random_streams.py"
        for line in path.read_text().splitlines()
        if re.search(r"2 ?\*\* ?31|spawn_key=\((?!\*)|(SeedSequence|default_rng)\((\d|\))", line)
    ]
    assert not found
