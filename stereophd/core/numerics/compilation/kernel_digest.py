"""The hash of the sources that a kernel is compiled from: its own file, and all of the package that it imports."""

from __future__ import annotations

import hashlib
import re
from functools import cache
from pathlib import Path

# The folder that holds the package.
PACKAGE_PARENT = Path(__file__).resolve().parents[4]

_IMPORT = re.compile(r"^\s*from (stereophd(?:\.\w+)*) import ([^\n#]+)", re.MULTILINE)


@cache
def _imported_files(file: Path) -> frozenset[Path]:
    """Return the files of the package that a file imports directly."""
    found = set()
    for module, names in _IMPORT.findall(file.read_text(encoding="utf-8")):
        path = PACKAGE_PARENT.joinpath(*module.split("."))
        if path.with_suffix(".py").is_file():
            found.add(path.with_suffix(".py"))
        for name in re.findall(r"\w+", names):
            if (path / f"{name}.py").is_file():
                found.add(path / f"{name}.py")
    return frozenset(found)


@cache
def source_digest(file: Path) -> str:
    """Return the hash of the contents of a source file and of all files of the package that it imports, in turn."""
    files, waiting = {file}, [file]
    while waiting:
        new = _imported_files(waiting.pop()) - files
        files |= new
        waiting += new
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()
