"""Install the wheel of a folder into an empty environment outside the source tree, and use it there.

    python .ci/try_wheel.py out/dist

Runs `stereophd demo`, every command that its last lines print, and a gate that must fail.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def main() -> None:
    """Install, run, and compare exit codes."""
    (wheel,) = Path(sys.argv[1]).resolve().glob("*.whl")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        venv.create(folder / "env", with_pip=True)
        binaries = folder / "env" / ("Scripts" if sys.platform == "win32" else "bin")
        constraints = ROOT / "constraints.txt"
        run(
            folder, [str(binaries / "python"), "-m", "pip", "install", "-q", "-c", str(constraints), f"{wheel}[report]"]
        )
        program = str(binaries / "stereophd")
        output = run(folder, [program, "demo", "out"])
        printed = [shlex.split(line) for line in output.splitlines() if line.startswith("  stereophd ")]
        if len(printed) != 2:
            sys.exit(f"demo: expected two commands to go on with, found {printed}")
        for words in printed:
            run(folder, [program, *words[1:]])
        gate = ["evaluate", "out/tracked/tracks.parquet", "out/simulated/truth.parquet", "--cutoff", "1"]
        run(folder, [program, *gate, "--fail-above", "ospa.mean=0.000001"], code=1)


def run(folder: Path, words: list[str], code: int = 0) -> str:
    """Run a command in a folder, without the variables of the source tree, and return what it printed."""
    print("+", shlex.join(words), flush=True)
    result = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    print(result.stdout, result.stderr, sep="", flush=True)
    if result.returncode != code:
        sys.exit(f"{words[0]}: expected exit code {code}, found {result.returncode}")
    return result.stdout


if __name__ == "__main__":
    main()
