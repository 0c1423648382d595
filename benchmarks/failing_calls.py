"""Each call that writes fails in turn: what is left, what is said, and what the next run makes of it.

    python benchmarks/failing_calls.py [--only WORD] [--every 1]

A small run of every command is made in a fork, under a library that is loaded before the C library and counts the calls
of all code (Python, Arrow, HDF5) that make, write, flush, lock, link or move a file in the place of the output. Then it
runs once for each of these calls, which alone fails: with EIO, or ENOSPC where bytes are written, into a fresh folder
and over an earlier run. A case passes if

- the exit code is 2 and the earlier files lie there as they were, or it is 0 and the files are those of a whole run;
- there is one clear message on stderr, and no traceback;
- the next run (`--force`, or `--resume` of what is kept) gives the files of a whole run, and nothing else is left. It
  is made where the one whose call failed left anything.

Prints a table. Exit code 1 if a case was not held. Needs a C compiler and a Unix system.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from faults import PREFIX
from small_runs import SmallRun, is_as_before, small_runs

LIBRARY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

static char root[4096];
static long seen, failing;
static char failed[5000];

void arm(const char *place, long number) {
    strncpy(root, place, sizeof root - 1); seen = 0; failing = number; failed[0] = 0;
}
long calls(void) { return seen; }
const char *what_failed(void) { return failed; }

static int fails(const char *name, int directory, const char *path, int error) {
    char whole[4096], link[64];
    if (!root[0]) return 0;
    int before = errno;
    if (path == NULL || (path[0] != '/' && directory != AT_FDCWD)) {
        snprintf(link, sizeof link, "/proc/self/fd/%d", directory);
        ssize_t length = readlink(link, whole, sizeof whole - 1);
        if (length < 0) { errno = before; return 0; }
        whole[length] = 0;
    } else strncpy(whole, path, sizeof whole - 1), whole[sizeof whole - 1] = 0;
    errno = before;
    if (strncmp(whole, root, strlen(root))) return 0;
    if (__sync_add_and_fetch(&seen, 1) != failing) return 0;
    snprintf(failed, sizeof failed, "%s %s", name, whole + strlen(root));
    errno = error;
    return 1;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define ON_FD(kind, name, error, arguments, ...) \
    kind name arguments { if (fails(#name, fd, NULL, error)) return -1; return REAL(name)(__VA_ARGS__); }
#define ON_PATH(name, directory, path, arguments, ...) \
    int name arguments { if (fails(#name, directory, path, EIO)) return -1; return REAL(name)(__VA_ARGS__); }

ON_FD(ssize_t, write, ENOSPC, (int fd, const void *data, size_t size), fd, data, size)
ON_FD(ssize_t, pwrite, ENOSPC, (int fd, const void *data, size_t size, off_t at), fd, data, size, at)
ON_FD(ssize_t, pwrite64, ENOSPC, (int fd, const void *data, size_t size, off64_t at), fd, data, size, at)
ON_FD(ssize_t, writev, ENOSPC, (int fd, const struct iovec *data, int count), fd, data, count)
ON_FD(int, fsync, EIO, (int fd), fd)
ON_FD(int, fdatasync, EIO, (int fd), fd)
ON_FD(int, ftruncate, EIO, (int fd, off_t size), fd, size)
ON_FD(int, ftruncate64, EIO, (int fd, off64_t size), fd, size)
int flock(int fd, int what);
ON_FD(int, flock, EIO, (int fd, int what), fd, what)
ON_PATH(truncate, AT_FDCWD, path, (const char *path, off_t size), path, size)
ON_PATH(truncate64, AT_FDCWD, path, (const char *path, off64_t size), path, size)
ON_PATH(rename, AT_FDCWD, b, (const char *a, const char *b), a, b)
ON_PATH(renameat, j, b, (int i, const char *a, int j, const char *b), i, a, j, b)
ON_PATH(renameat2, j, b, (int i, const char *a, int j, const char *b, unsigned how), i, a, j, b, how)
ON_PATH(link, AT_FDCWD, b, (const char *a, const char *b), a, b)
ON_PATH(linkat, j, b, (int i, const char *a, int j, const char *b, int how), i, a, j, b, how)
int mkdir(const char *path, mode_t mode);
ON_PATH(mkdir, AT_FDCWD, path, (const char *path, mode_t mode), path, mode)
int chmod(const char *path, mode_t mode);
ON_PATH(chmod, AT_FDCWD, path, (const char *path, mode_t mode), path, mode)

#define OPENS(name, directory, before, ...) \
    int name(before const char *path, int how, ...) { \
        mode_t mode = 0; va_list more; va_start(more, how); \
        if (how & O_CREAT) mode = va_arg(more, mode_t); va_end(more); \
        if ((how & O_CREAT) && fails(#name, directory, path, EIO)) return -1; \
        return ((int (*)())dlsym(RTLD_NEXT, #name))(__VA_ARGS__); }
#define AT int where,
OPENS(open, AT_FDCWD, , path, how, mode)
OPENS(open64, AT_FDCWD, , path, how, mode)
OPENS(openat, where, AT, where, path, how, mode)
OPENS(openat64, where, AT, where, path, how, mode)
"""


def files(place: Path) -> dict[str, bytes]:
    """Return the files below a place, without those that state times."""
    found = sorted(path for path in place.rglob("*") if path.is_file())
    return {str(path.relative_to(place)): path.read_bytes() for path in found if path.name != "timing.json"}


def in_final_places(found: Mapping[str, bytes], what: str) -> dict[str, bytes]:
    """Leave out what an unfinished run keeps for the next one, and a lock that could not be taken (it stays, free)."""
    kept = ("partial-", PREFIX) if what.startswith("flock") else ("partial-",)
    return {name: text for name, text in found.items() if not any(p.startswith(kept) for p in Path(name).parts)}


def forked(library: ctypes.CDLL, words: list[str], place: Path, failing: int) -> tuple[int, str, int, str]:
    """Run a command in a fork; return its exit code, its messages, its number of calls, and the one that failed."""
    from stereophd.cli.app import run

    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        said = io.StringIO()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            library.arm(os.fsencode(place), failing)
            try:
                code = run(words)
            except BaseException as error:
                code, _ = 3, said.write(f"{type(error).__name__}: {error}")
            calls, what = library.calls(), library.what_failed().decode()
            library.arm(b"", 0)
        with os.fdopen(writing, "w") as pipe:
            json.dump([code, said.getvalue(), calls, what], pipe)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        text = pipe.read()
    status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    if not text:
        return 3, f"the process ended with {status}", 0, "?"
    code, said, calls, what = json.loads(text)
    return code, said, calls, what


def tried(
    library: ctypes.CDLL, case: SmallRun, place: Path, whole: Mapping[str, bytes], failing: int, over: bool
) -> tuple[str, str]:
    """Let one call fail; return which, and what was wrong."""
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    earlier = {name: b"of an earlier run" * bool(text) for name, text in whole.items()} if over else {}
    for name, text in earlier.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_bytes(text)
    code, said, _, what = forked(library, case.command(place, *(["--force"] if over else [])), place, failing)
    found = in_final_places(files(place), what)
    if code not in (0, 2) or "Traceback" in said:
        return what, f"exit code {code}: {said[-300:]}"
    if code == 2 and "error: " not in said.lower():
        return what, f"no message: {said[-300:]}"
    if not (found == whole if code == 0 else is_as_before(found, earlier, whole, case.in_parts)):
        changed = [name for name in found.keys() | whole.keys() if found.get(name) != earlier.get(name)]
        return what, f"exit code {code}, and there lie {sorted(found)}; changed: {sorted(changed)}"
    if files(place) in (earlier, dict(whole)) and not any(place.rglob(f"{PREFIX}*")):
        return what, ""  # nothing tells the next run of this one
    code, said, _, _ = forked(library, case.next_run(place, over), place, 0)
    if code:
        return what, f"the next run ends with {code}: {said[-300:]}"
    found = files(place)
    if found != whole:
        other = sorted(name for name in found.keys() | whole.keys() if found.get(name) != whole.get(name))
        return what, f"the next run leaves other files: {other}"
    return what, ""


def main() -> int:
    """Try all calls of all commands; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="")
    parser.add_argument("--every", type=int, default=1, help="try every so manieth call")
    options = parser.parse_args()
    if "FAILING_CALLS" not in os.environ:
        with tempfile.TemporaryDirectory() as name:
            source, library = Path(name, "calls.c"), Path(name, "calls.so")
            source.write_text(LIBRARY, encoding="utf-8")
            subprocess.run(["cc", "-shared", "-fPIC", "-w", "-o", library, source, "-ldl"], check=True)
            environment = {**os.environ, "LD_PRELOAD": str(library), "FAILING_CALLS": str(library)}
            return subprocess.run([sys.executable, *sys.argv], env=environment, check=False).returncode
    library = ctypes.CDLL(os.environ["FAILING_CALLS"])
    library.what_failed.restype = ctypes.c_char_p
    library.calls.restype = ctypes.c_long
    library.arm.argtypes = [ctypes.c_char_p, ctypes.c_long]
    from stereophd.pipeline.runs import unfinished

    unfinished.KEEP_EVERY_S, unfinished.MOST_SHARE = 0.02, 1e9  # so that small runs keep their states
    not_held = 0
    with tempfile.TemporaryDirectory() as name:
        place = Path(name, "place")
        print("| command | calls | tried | held |\n|---|---|---|---|", flush=True)
        for title, case in small_runs(Path(name, "inputs")).items():
            if options.only not in title or "--jobs 2" in title:  # a worker is a process of its own
                continue
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir()
            code, said, calls, _ = forked(library, case.command(place), place, 0)
            if code:
                raise RuntimeError(f"{title}: exit code {code}: {said}")
            whole, count = files(place), Counter[str]()
            for over in (False, True):
                for failing in range(1, calls + 1, options.every):
                    what, wrong = tried(library, case, place, whole, failing, over)
                    count.update({"tried": 1, "held": not wrong})
                    if wrong:
                        print(f"  {title}{' over an earlier run' if over else ''}: {what}: {wrong}", file=sys.stderr)
            not_held += count["tried"] - count["held"]
            print(f"| `{title}` | {calls} | {count['tried']} | {count['held']} |", flush=True)
    return int(not_held > 0)


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    sys.exit(main())
