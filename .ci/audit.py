"""Look up known vulnerabilities of every version in constraints.txt, where the advisory service answers.

    python .ci/audit.py FOLDER

pip-audit asks the service for each locked version; it is installed into an environment of its own in the folder, so
that the locked ones stay as they are. It has no list of its own: without a network nothing is known, which is said, and
is no failure. Exit code 1 if a version is vulnerable.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

PIP_AUDIT = "pip-audit==2.10.1"
CONSTRAINTS = Path(__file__).resolve().parent.parent / "constraints.txt"


def main(folder: Path) -> int:
    """Audit; return the exit code."""
    python = folder / "bin" / "python"
    try:
        subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
        subprocess.run([python, "-m", "pip", "install", "--quiet", PIP_AUDIT], check=True, timeout=300)
        words = ["-r", str(CONSTRAINTS), "--no-deps", "--disable-pip", "--progress-spinner", "off", "--format", "json"]
        done = subprocess.run(
            [python, "-m", "pip_audit", *words], capture_output=True, text=True, timeout=600, check=False
        )
        found = json.loads(done.stdout)["dependencies"]
    except (subprocess.SubprocessError, OSError, ValueError, KeyError) as error:
        print(f"not audited: {error}")
        return 0
    looked_at = [item for item in found if "vulns" in item]
    for item in looked_at:
        for vulnerability in item["vulns"]:
            fixed = ", ".join(vulnerability["fix_versions"]) or "no version"
            print(f"{item['name']} {item['version']}: {vulnerability['id']}, mended in {fixed}")
    print(f"{len(looked_at)} of {len(found)} locked versions looked up")
    return int(any(item["vulns"] for item in looked_at))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
