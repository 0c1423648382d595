"""Every command runs as a user who owns nothing: no home that can be written to, no folder of kernels of their own."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

UID = 54_321  # of nobody
PACKAGE = Path(__file__).resolve().parents[2]
CONFIG = PACKAGE / "configs" / "quickstart.yaml"

# The commands, one after the other in one process: `OUT` is the only folder that belongs to the user.
COMMANDS = """
simulate CONFIG --set simulate.duration_s=1 --out OUT/scene
info OUT/scene
check CONFIG OUT/scene/detections.parquet
config check CONFIG
config show CONFIG
config schema
track CONFIG OUT/scene/detections.parquet --out OUT/tracked
evaluate OUT/tracked/tracks.parquet OUT/scene/truth.parquet --cutoff 1 --out OUT/scores --no-plots
evaluate-cameras OUT/scene/cameras.yaml OUT/scene/cameras.yaml
export csv OUT/tracked --out OUT/tracks.csv
export opencv OUT/scene/cameras.yaml --out OUT/rig.yml
import opencv OUT/rig.yml --out OUT/imported
init OUT/new --log OUT/scene/detections.parquet --cameras OUT/scene/cameras.yaml
"""
PROGRAM = """
import os, sys
sys.path[:0] = sys.argv[1].split(os.pathsep)
from stereophd.cli.app import run
assert os.getuid() and not os.access(os.environ["HOME"], os.W_OK)
for words in filter(None, sys.argv[2].splitlines()):
    code = run([*words.split(), "-q"])
    print(code, words, file=sys.stderr)
"""


def as_other_user(python: str, paths: str) -> list[str] | None:
    """Return the words that start Python as the other user, who may be unable to read it: None."""
    words = ["setpriv", f"--reuid={UID}", f"--regid={UID}", "--clear-groups", "env", "-i", "HOME=/nonexistent"]
    words += [f"{name}={os.environ[name]}" for name in ("NUMBA_CACHE_DIR",) if name in os.environ]
    words += ["PYTHONDONTWRITEBYTECODE=1", python]
    program = "import sys; sys.path[:0] = sys.argv[1].split(':'); import numba, pyarrow, stereophd"
    done = subprocess.run([*words, "-c", program, paths], capture_output=True, check=False, cwd="/")
    return words if done.returncode == 0 else None


@pytest.mark.skipif(
    not hasattr(os, "getuid") or os.getuid() != 0 or shutil.which("setpriv") is None,
    reason="only root can run a command as another user (needs setpriv)",
)
def test_every_command_runs_as_another_user(tmp_path: Path) -> None:
    paths = f"{PACKAGE}:{sysconfig.get_paths()['purelib']}"
    words = as_other_user(sys.executable, paths)
    if words is None:
        pytest.skip("another user cannot read this Python and its packages")
    own = Path("/tmp") / f"stereophd-other-user-{os.getpid()}"
    own.mkdir()
    try:
        os.chown(own, UID, UID)
        lines = COMMANDS.strip().replace("CONFIG", str(CONFIG)).replace("OUT", str(own))
        done = subprocess.run([*words, "-c", PROGRAM, paths, lines], capture_output=True, text=True, cwd=own)
        codes = [line for line in done.stderr.splitlines() if line[:1].isdigit()]
        assert len(codes) == len(lines.splitlines()), done.stderr[-2000:]
        assert [line for line in codes if not line.startswith("0 ")] == [], done.stderr[-2000:]
        assert "Traceback" not in done.stderr
    finally:
        shutil.rmtree(own)
        # where no other folder can be read and trusted, the kernels of the user are kept there
        shutil.rmtree(Path("/tmp", f"stereophd-kernels-{UID}"), ignore_errors=True)
