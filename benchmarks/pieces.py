"""A log tracked in pieces against the whole run: OSPA(2), identity switches, joins that are uncertain, time and memory.

    python benchmarks/pieces.py CONFIG LOG --pieces 3600 [--overlap 60] [--truth TRUTH] [--cutoff 20] [--set KEY=VALUE]
                                [--out DIR] [--json]

Tracks the log whole and in pieces, in processes of their own, and scores the tracks of the pieces against those of the
whole run as if these were the truth; with a truth, both against it as well. With `--out` the outputs stay there, and
what is finished there already is not done again.
"""

from __future__ import annotations

# Nothing heavy is imported here: on Linux the peak memory of a child counts from that of its parent.
import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

COMMAND = [sys.executable, "-m", "stereophd"]
COLUMNS = ("time_s", "track_id", "x", "y", "z", "vx", "vy", "vz")


def main() -> int:
    """Measure and print."""
    options = _parse()
    with tempfile.TemporaryDirectory() as name:
        folder = options.out or Path(name)
        words = ["track", str(options.config), str(options.log), *options.words, "--resume"]
        cut = ["--pieces", str(options.pieces), "--overlap", str(options.overlap), "--jobs", str(options.jobs)]
        report: dict[str, Any] = {
            "whole": _run([*words, "--out", str(folder / "whole")]),
            "pieces": _run([*words, *cut, "--out", str(folder / "pieces")]),
        }
        done = json.loads((folder / "pieces" / "report.json").read_text())
        report["events"], report["duration_s"], report["joins"] = done["events"], done["duration_s"], done["pieces"]
        _as_truth(folder / "whole" / "tracks.parquet", folder / "whole_as_truth.parquet")
        cutoff = ["--cutoff", str(options.cutoff)]
        report["against_whole"] = _score(folder / "pieces", folder / "whole_as_truth.parquet", cutoff)
        if options.truth:
            for one in ("whole", "pieces"):
                report[f"{one}_against_truth"] = _score(folder / one, options.truth, cutoff)
    print(json.dumps(report, indent=2))
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path)
    parser.add_argument("log", type=Path)
    parser.add_argument("--pieces", type=float, required=True)
    parser.add_argument("--overlap", type=float, default=60.0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--cutoff", type=float, default=20.0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    options.words = [word for change in options.set for word in ("--set", change)]
    options.words += ["--cameras", str(options.cameras)] if options.cameras else []
    return options


def _run(words: list[str]) -> dict[str, float]:
    """Run the command line; return wall and processor time, s, and the peak memory, MB."""
    start = time.monotonic()
    process = subprocess.Popen([*COMMAND, *words, "-q"])
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"exit code {process.returncode}: {' '.join(words)}")
    cpu_s = usage.ru_utime + usage.ru_stime
    return {"wall_s": time.monotonic() - start, "cpu_s": cpu_s, "peak_mb": usage.ru_maxrss / 1024.0}


def _as_truth(tracks: Path, out: Path) -> None:
    """Write tracks as a truth: each track once at each time, after its last event."""
    code = (
        "import sys, pyarrow.parquet as pq, pyarrow as pa, pyarrow.compute as pc, numpy as np\n"
        "table = pq.read_table(sys.argv[1])\n"
        "if 'status' in table.schema.names:\n"
        "    table = table.filter(pc.equal(table['status'], 'confirmed'))\n"
        f"table = table.select({list(COLUMNS)!r})\n"
        "key = np.stack([table['time_s'].to_numpy(), table['track_id'].to_numpy().astype(float)], axis=1)\n"
        "_, last = np.unique(key[::-1], axis=0, return_index=True)\n"
        "table = table.take(pa.array(np.sort(len(key) - 1 - last)))\n"
        "names = ['object_id' if name == 'track_id' else name for name in table.schema.names]\n"
        "table = pa.table(table.columns, names=names).replace_schema_metadata(None)\n"
        "pq.write_table(table.sort_by([('time_s', 'ascending'), ('object_id', 'ascending')]), sys.argv[2])\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tracks), str(out)], check=True)


def _score(folder: Path, truth: Path, cutoff: list[str]) -> dict[str, Any]:
    """Return the figures that `evaluate` gives."""
    words = ["evaluate", str(folder / "tracks.parquet"), str(truth), *cutoff, "--json"]
    done = subprocess.run([*COMMAND, *words], capture_output=True, text=True, check=True)
    report = json.loads(done.stdout)
    return {
        "ospa": report["ospa"]["mean"],
        "ospa2": report["ospa2"]["mean"],
        "identity_switches": report["identity_switches"],
        "scans": report["scans"]["scored"],
        "fragmentation": report["completeness"]["fragmentation"],
    }


if __name__ == "__main__":
    sys.exit(main())
