"""Linear algebra works on one thread, unless the environment says otherwise."""

import os
import subprocess
import sys

import pytest

from stereophd.core.numerics.threads import OF_ALL, OF_LINEAR_ALGEBRA, use_one_thread


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ({}, dict.fromkeys(OF_LINEAR_ALGEBRA, "1")),
        ({"MKL_NUM_THREADS": "3"}, {**dict.fromkeys(OF_LINEAR_ALGEBRA, "1"), "MKL_NUM_THREADS": "3"}),
        ({OF_ALL: "2"}, {}),
    ],
)
def test_the_environment_has_precedence(
    monkeypatch: pytest.MonkeyPatch, stated: dict[str, str], expected: dict[str, str]
) -> None:
    monkeypatch.setattr(os, "environ", dict(stated))
    use_one_thread()
    assert {name: value for name, value in os.environ.items() if name != OF_ALL} == expected


def test_the_command_line_loads_numpy_with_one_thread() -> None:
    """The variables are set before NumPy is imported."""
    script = """
import os, sys
class Watch:
    def find_spec(self, name, path=None, target=None):
        if name == "numpy":
            print(os.environ["OPENBLAS_NUM_THREADS"])
sys.meta_path.insert(0, Watch())
sys.argv = ["stereophd", "info", "missing.parquet"]
from stereophd.__main__ import main
main()
"""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.stdout.splitlines()[0] == "1"
