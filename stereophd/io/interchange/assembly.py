"""Detections in any order, as a foreign file has them, become a native log, in bounded memory.

Two passes. The first appends each camera's rows to a temporary file, and remembers whether they are in order. The
second reads these files in pieces, removes duplicates, numbers and times the frames, fills in the frames without
detections, and merges the cameras by time. Rows of a camera that are out of order are sorted in memory, one camera
at a time.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from stereophd.core.arrays import Array
from stereophd.core.settings import LARGEST_TIME_S
from stereophd.errors import InputError
from stereophd.io.documents import check_instant
from stereophd.io.interchange.base import EXTRA_COLUMNS, ForeignRecording, ImportOptions, Piece, named_files
from stereophd.io.logs.checks import repeated_rows
from stereophd.io.logs.rows import log_schema
from stereophd.io.tables.writing import TableWriter
from stereophd.wording import counted, instant

FRAME, TIME, U, V = range(4)
COLUMNS = ("frame", "time_s", "u_px", "v_px", *EXTRA_COLUMNS)
WIDTH, LABEL = len(COLUMNS), COLUMNS.index("object_id")
# Rows of a piece of a temporary file.
PIECE_ROWS = 65536
# Largest number of a frame, or of an object: beyond it not every whole number is a float.
MAX_FRAME = 2.0**53


@dataclass
class Spool:
    """The rows of one camera in a temporary file: frame, time, u, v and extra columns, all float64."""

    path: Path
    stream: BinaryIO
    files: dict[Path, None] = field(default_factory=dict)  # Those that have rows, in order
    rows: int = 0
    last: float = -math.inf
    in_order: bool = True
    has_frames: bool = True
    has_whole_times: bool = True
    has_times: bool = False
    # `half`, `first_half`: Rows with one coordinate, which are bad ones of the log, too, and the place of the first.
    half: int = 0
    first_half: str = ""
    low: int = 0  # Detections of a score that is too low
    extra: set[str] = field(default_factory=set)  # Extra columns that have a value in some row

    def discard(self) -> None:
        """Close the file and remove it."""
        self.stream.close()
        self.path.unlink(missing_ok=True)


def spool_pieces(recording: ForeignRecording, folder: Path, options: ImportOptions) -> dict[str, Spool]:
    """Append every piece to the temporary file of its camera, with gaps for detections of a score that is too low."""
    spools: dict[str, Spool] = {}
    for piece in recording.pieces or ():
        if not len(piece.pixels):
            continue
        spool = spools.get(piece.camera)
        if spool is None:
            path = folder / f"camera-{len(spools)}.rows"
            spool = spools[piece.camera] = Spool(path, open(path, "w+b"))  # noqa: SIM115 (closed by discard)
        if "score" in piece.extra and options.least_score is not None:
            is_low = piece.extra["score"] < options.least_score
            spool.low += int((is_low & ~np.isnan(piece.pixels[:, 0])).sum())
            gaps = {name: np.where(is_low, np.nan, values) for name, values in piece.extra.items()}
            piece = replace(piece, pixels=np.where(is_low[:, None], np.nan, piece.pixels), extra=gaps)
        _append(spool, piece, f"{piece.file}: camera {piece.camera}")
    return spools


def _append(spool: Spool, piece: Piece, where: str) -> None:
    count = len(piece.pixels)
    spool.files[piece.file] = None
    rows = np.full((count, WIDTH), np.nan)
    if piece.frame is not None:
        rows[:, FRAME] = piece.frame
    if piece.time_s is not None:
        rows[:, TIME] = piece.time_s
    rows[:, U : V + 1] = piece.pixels
    if np.isinf(rows[:, U : V + 1]).any():
        raise InputError(f"{where}: expected finite pixels, found infinity")
    for name, values in piece.extra.items():
        rows[:, COLUMNS.index(name)] = values
        if not np.isnan(values).all():
            spool.extra.add(name)
    identities = rows[:, LABEL]
    if (np.abs(identities[~np.isnan(identities)]) > MAX_FRAME).any():
        raise InputError(f"{where}: expected whole identities of objects, found one beyond 2^53")
    spool.has_frames &= piece.frame is not None
    spool.has_times |= bool(np.isfinite(rows[:, TIME]).any())
    spool.has_whole_times &= bool((rows[:, TIME] % 1.0 == 0.0).all())
    what, at = ("frame number", FRAME) if spool.has_frames else ("time", TIME)
    key: Array = rows[:, at]
    if not np.isfinite(key).all():
        raise InputError(f"{where}: expected {what}s, found a row without one")
    if len(half := np.flatnonzero(np.isnan(piece.pixels).sum(axis=1) == 1)):
        spool.half, spool.first_half = spool.half + len(half), spool.first_half or f"{what} {key[half[0]]:.12g}"
    broken = key[(key % 1.0 != 0.0) | (np.abs(key) > MAX_FRAME)]
    if spool.has_frames and len(broken):
        raise InputError(f"{where}: expected whole frame numbers, found {broken[0]:g}")
    spool.in_order &= bool(key[0] >= spool.last and (np.diff(key) >= 0).all())
    spool.last = float(key[-1])
    spool.rows += count
    spool.stream.write(rows.data)  # `tofile` would not say why the disk refuses it


def read_rows(spool: Spool) -> Iterator[Array]:
    """Yield the rows of a temporary file in order, in pieces."""
    spool.stream.flush()
    if not spool.in_order:
        rows = np.fromfile(spool.path).reshape(-1, WIDTH)
        order = np.argsort(rows[:, FRAME if spool.has_frames else TIME], kind="stable")
        for start in range(0, len(rows), PIECE_ROWS):
            yield rows[order[start : start + PIECE_ROWS]]
        return
    with open(spool.path, "rb") as stream:
        while True:
            values = np.fromfile(stream, count=PIECE_ROWS * WIDTH)
            if not len(values):
                return
            yield values.reshape(-1, WIDTH)


# A camera's log may grow by this factor and number when missing frames are filled in; more is a wrong column.
LARGEST_GROWTH, FEW_FRAMES = 1000, 1_000_000
# With this many frame numbers, one recording of a thousand has a common divisor by chance.
LEAST_FRAMES_OF_A_STEP = 10
# Times without frame numbers are even if this share of their steps are multiples of the interval, to within this part
# of it. The step at this quantile is about one interval, even where most frames have no detection.
EVEN_SHARE, EVEN_PART, SHORT_STEP = 0.95, 0.2, 0.1
# Frames by which times of the rows of one frame may scatter, as by the clocks of a camera; beyond it numbers repeat.
MOST_SCATTERED = 10.0
# Most frames that a recording may be said to have: a day at 10 kHz.
MOST_FRAMES = 1_000_000_000


@dataclass
class CameraSummary:
    """Counts of a camera's rows; keys of the import's report."""

    frames: int = 0
    empty_frames: int = 0
    filled_frames: int = 0
    detections: int = 0
    duplicate_rows: int = 0
    repeated_labels: int = 0  # Detections whose object has another detection in the same frame
    first_s: float | None = None
    last_s: float | None = None
    rate_hz: float | None = None  # Without the pauses
    has_whole_times: bool = False  # In the source
    in_unit_square: int = 0  # Detections whose pixels lie between 0 and 1
    # `pauses`, `paused_s`: Gaps in even times that are no frames without detections, and how long they last together.
    pauses: int = 0
    paused_s: float = 0.0


def write_native_log(
    recording: ForeignRecording, options: ImportOptions, path: Path, folder: Path, metadata: Mapping[Any, Any]
) -> dict[str, CameraSummary]:
    """Write the detections of a recording, whose pieces are consumed, as a native log.

    The options have rates, offsets and recorded frames of the cameras, and say whether missing frames are filled in.
    `folder` is for temporary files, which are removed. Returns a summary by camera, in order of their names (or of the
    recording's cameras). Raises InputError for no detections, a camera with neither times nor a rate, or frame numbers
    that cannot be.
    """
    spools = spool_pieces(recording, folder, options)
    try:
        if not spools:
            raise InputError(f"{recording.source}: expected detections, found none")
        extra = [name for name in EXTRA_COLUMNS if any(name in spool.extra for spool in spools.values())]
        if "score" in extra and options.least_score is None:
            recording.assumed.append("scores (likelihoods) are not used: `least_score` leaves out what has a lower one")
        order = [name for name in recording.cameras if name in spools]
        order += sorted(name for name in spools if name not in recording.cameras)
        summaries = {name: CameraSummary() for name in order}
        cameras = [_Camera(name, spools[name], recording, options, summaries[name]) for name in order]
        with TableWriter(path, log_schema(extra), metadata) as table:
            for index, rows in _merged([camera.pieces() for camera in cameras]):
                table.append(_columns(index, rows, order, extra))
    finally:
        for spool in spools.values():
            spool.discard()
    return summaries


class _Camera:
    """The second pass over one camera."""

    def __init__(
        self, name: str, spool: Spool, recording: ForeignRecording, options: ImportOptions, summary: CameraSummary
    ) -> None:
        self._name, self._spool, self._summary = name, spool, summary
        self._where = where = f"{named_files(spool.files)}: camera {name}"
        summary.has_whole_times = spool.has_whole_times
        if spool.half:
            recording.warnings.append(
                f"{where}: {counted(spool.half, 'row')} with one of u and v, the first at {spool.first_half}: correct "
                "the source, or let runs drop such rows (input.on_bad_row: drop)"
            )
        if spool.low:
            recording.assumed.append(f"{name}: {counted(spool.low, 'detection')} below `least_score` left out")
        stated = options.rates.get(name)
        self._rate = stated if stated is not None else recording.rates.get(name)
        if self._rate is not None and not 0.0 < self._rate < math.inf:
            raise InputError(f"{where}: rate: expected frames per second > 0, found {self._rate:g}")
        self._is_rate_stated, self._is_timed_by_rate = stated is not None, False
        self._untimed = recording.untimed
        if spool.has_times and stated is not None:
            recording.assumed.append(f"{name}: times are by `rates`: those of the source are not used")
        self._first_frame, self._offset = recording.first_frame, options.offsets.get(name) or 0.0
        self._range = options.frames.get(name) or recording.frames.get(name)
        if self._range is not None and self._range[1] - self._range[0] > MOST_FRAMES:
            raise InputError(f"{where}: frames: expected at most {MOST_FRAMES}, found up to {self._range[1]}")
        self._fill = options.fill and not recording.lists_frames
        if not spool.has_frames and (unused := [key for key in ("rates", "frames") if getattr(options, key).get(name)]):
            raise InputError(f"`{unused[0]}`: expected frame numbers of camera {name}, found times only")
        if not options.fill and options.frames.get(name):
            raise InputError("`frames`: expected `fill`, which adds the frames without rows, found it turned off")
        self._stride = self._measure_stride() if spool.has_frames else 1
        self._interval_s, self._longest_gap = self._measure_interval()
        if self._interval_s is not None:
            recording.assumed.append(
                f"{name}: frames come every {self._interval_s:.4g} s, and have no detection where the source has none: "
                "it has no frame numbers (turn `fill` off if they were not recorded)"
            )
        elif not spool.has_frames:
            recording.assumed.append(
                f"{name}: the source has no frame numbers, so that frames without detections are not in the log: where "
                "there are some, the probability of detection will be estimated too high"
            )
        self._last: Array | None = None
        self._latest_s = -np.inf  # Of any row of the last frame

    def _measure_stride(self) -> int:
        """Return the step of the frame numbers: the greatest that divides all differences; 1 of too few frames."""
        stride, count = 0, 0
        last = np.empty(0, dtype=np.int64)
        for rows in read_rows(self._spool):
            frames = np.unique(np.append(last, rows[:, FRAME].astype(np.int64)))
            stride = math.gcd(stride, int(np.gcd.reduce(np.diff(frames))))
            count += len(frames) - len(last)
            last = frames[-1:]
        return stride if stride and count >= LEAST_FRAMES_OF_A_STEP else 1

    def _measure_interval(self) -> tuple[float | None, int]:
        """Return the interval of frames that have times only, s; None where their times are uneven, or few.

        Also the longest step that misses may explain, in intervals: as many as there are frames with detections. In a
        longer one nobody knows whether the camera looked.
        """
        if self._spool.has_frames or not self._fill:
            return None, 0
        rows = next(read_rows(self._spool))
        steps = np.diff(np.unique(rows[:, TIME]))
        if len(steps) < LEAST_FRAMES_OF_A_STEP:
            return None, 0
        shortest = float(np.quantile(steps, SHORT_STEP))
        count = np.rint(steps / shortest)
        within = count <= len(steps)
        even = within & (np.abs(steps / shortest - count) < EVEN_PART)
        is_even = even.sum() >= EVEN_SHARE * within.sum()
        return (float(steps[even].sum() / count[even].sum()) if is_even else None), len(steps)

    def pieces(self) -> Iterator[Array]:
        """Yield the camera's rows as the log has them: whole frames, timed, without gaps, in order."""
        carry: Array | None = None
        for rows in read_rows(self._spool):
            if carry is not None:
                rows = np.concatenate([carry, rows])
            key = rows[:, FRAME] if self._spool.has_frames else rows[:, TIME]
            complete = int(np.searchsorted(key, key[-1], side="left"))
            carry = rows[complete:]
            check_instant(len(carry), float(key[-1]), self._where)
            if complete:
                yield self._finished(rows[:complete], is_last=False)
        assert carry is not None
        yield self._finished(carry, is_last=True)

    def _finished(self, rows: Array, is_last: bool) -> Array:
        rows = self._timed(rows.copy())
        if LARGEST_TIME_S < (largest := float(np.abs(rows[:, TIME]).max())) < math.inf:
            raise InputError(f"{self._where}: expected times in seconds, found {largest:.4g}")
        is_repeated = repeated_rows(rows[:, FRAME], rows[:, U : V + 1], np.arange(len(rows)))
        # a gap beside detections is left out as well, and is none of them
        self._summary.duplicate_rows += int((is_repeated & np.isfinite(rows[:, U : V + 1]).any(axis=1)).sum())
        rows = rows[~is_repeated]
        labelled = rows[rows[:, LABEL] >= 0.0][:, [FRAME, LABEL]]
        self._summary.repeated_labels += len(labelled) - len(np.unique(labelled, axis=0))
        if self._fill and (self._spool.has_frames or self._interval_s is not None):
            rows = self._filled(rows, is_last)
        self._last = rows[-1]
        self._summarise(rows)
        return rows

    def _timed(self, rows: Array) -> Array:
        """Number the frames and give them times, each frame one."""
        if not self._spool.has_frames:
            rows[:, TIME] += self._offset
            times, index = np.unique(rows[:, TIME], return_inverse=True)
            before, number = (times[0], 0.0) if self._last is None else (self._last[TIME], self._last[FRAME])
            steps = np.diff(times, prepend=before)
            count = (steps > 0.0).astype(np.float64)
            if self._interval_s is not None:
                count = np.rint(steps / self._interval_s).clip(count)
                pauses = count > self._longest_gap
                count[pauses] = 1.0
                self._summary.pauses += int(pauses.sum())
                self._summary.paused_s += float(steps[pauses].sum())
            rows[:, FRAME] = number + np.cumsum(count)[index]
            return rows
        frames, starts, index = np.unique(rows[:, FRAME], return_index=True, return_inverse=True)
        earliest, latest = (reduced.reduceat(rows[:, TIME], starts) for reduced in (np.minimum, np.maximum))
        has_times = np.isfinite(rows[:, TIME]).all()
        if self._rate is not None and (self._is_rate_stated or not has_times):
            if len(bad := np.flatnonzero((latest - earliest) * self._rate > MOST_SCATTERED)):
                raise InputError(
                    f"{self._where}: expected frame numbers that do not begin anew, found frame {frames[bad[0]]:.0f} "
                    f"from {instant(earliest[bad[0]], 9)} to {instant(latest[bad[0]], 9)} s"
                )
            self._is_timed_by_rate = True
            rows[:, TIME] = self._by_rate(rows[:, FRAME], self._rate)
            return rows
        if not has_times:
            untimed = rows[~np.isfinite(rows[:, TIME]), FRAME]
            found = f"frame {untimed[0]:.0f} without a time" if self._spool.has_times else "frame numbers only"
            raise InputError(
                f"{self._where}: expected times or `rates` (frames per second), found {found}{self._untimed}"
            )
        before, self._latest_s = np.append(self._latest_s, latest[:-1]), latest[-1]
        if len(bad := np.flatnonzero(earliest <= before)):
            raise InputError(
                f"{self._where}: expected times that increase with the frame number, found "
                f"{instant(earliest[bad[0]], 9)} s at frame {frames[bad[0]]:.0f}, not after "
                f"{instant(before[bad[0]], 9)} s of the frame before: give each frame a number and a time of its own, "
                "or state `rates` where numbers count frames and times scatter"
            )
        rows[:, TIME] = rows[starts[index], TIME] + self._offset
        return rows

    def _by_rate(self, frames: Array, rate: float) -> Array:
        return (frames - self._first_frame) / rate + self._offset

    def _filled(self, rows: Array, is_last: bool) -> Array:
        """Add a row for each frame that is missing after the last row before, between these, and at the ends."""
        known = rows if self._last is None else np.vstack([self._last, rows])
        frames, index = np.unique(known[:, FRAME], return_index=True)
        times = known[index, TIME]
        first, last = frames[0], frames[-1]
        if self._range is not None:
            first = min(first, self._range[0]) if self._last is None else first
            last = max(last, self._range[1]) if is_last else last
        count = (last - first) / self._stride + 1
        if count > max(LARGEST_GROWTH * len(frames), FEW_FRAMES):
            raise InputError(
                f"{self._where}: expected frame numbers that count frames, found {first:.0f} to {last:.0f} "
                f"for {len(frames)} frames with detections"
            )
        # counted from a frame that exists: the stated range may begin between two multiples
        below = np.arange(frames[0] - self._stride, first - 0.5, -self._stride)[::-1]
        missing = np.concatenate([below, np.setdiff1d(np.arange(frames[0], last + 0.5, self._stride), frames)])
        if not len(missing):
            return rows
        new = np.full((len(missing), rows.shape[1]), np.nan)
        new[:, FRAME] = missing
        new[:, TIME] = self._times_of(missing, frames, times)
        self._summary.filled_frames += len(missing)
        merged = np.concatenate([rows, new])
        return merged[np.argsort(merged[:, FRAME], kind="stable")]

    def _times_of(self, missing: Array, frames: Array, times: Array) -> Array:
        """Return times of missing frames: by the rate, between neighbours, and beyond the ends by the mean period."""
        if self._rate is not None and self._is_timed_by_rate:
            return self._by_rate(missing, self._rate)
        result = np.interp(missing, frames, times)
        if len(frames) > 1:
            period = (times[-1] - times[0]) / (frames[-1] - frames[0])
        elif self._rate is not None:
            period = 1.0 / self._rate
        else:
            raise InputError(f"{self._where}: expected a rate, or frames at two times, to time empty frames")
        result = np.where(missing < frames[0], times[0] + (missing - frames[0]) * period, result)
        return np.where(missing > frames[-1], times[-1] + (missing - frames[-1]) * period, result)

    def _summarise(self, rows: Array) -> None:
        summary = self._summary
        coordinates = np.isfinite(rows[:, U : V + 1]).sum(axis=1)
        summary.frames += len(np.unique(rows[:, FRAME]))
        summary.empty_frames += int((coordinates == 0).sum())
        summary.detections += int((coordinates == 2).sum())
        summary.first_s = float(rows[0, TIME]) if summary.first_s is None else summary.first_s
        summary.last_s = float(rows[-1, TIME])
        summary.in_unit_square += int(((rows[:, U : V + 1] >= 0.0) & (rows[:, U : V + 1] <= 1.0)).all(axis=1).sum())
        lasted, steps = summary.last_s - summary.first_s - summary.paused_s, summary.frames - 1 - summary.pauses
        if steps > 0 and lasted > 0.0:
            # without the round-off of the times, which files of cameras would show
            summary.rate_hz = float(f"{steps / lasted:.12g}")


def _merged(streams: Sequence[Iterator[Array]]) -> Iterator[tuple[NDArray[np.int64], Array]]:
    """Merge the pieces of all cameras by time, ties in their order; yields the camera of each row, and the rows."""
    waiting: list[Array | None] = [next(stream, None) for stream in streams]
    while any(rows is not None for rows in waiting):
        # what is no later than the end of every camera's piece is complete
        limit = min(float(rows[-1, TIME]) for rows in waiting if rows is not None)
        index, ready = [], []
        for k, rows in enumerate(waiting):
            if rows is None:
                continue
            count = int(np.searchsorted(rows[:, TIME], limit, side="right"))
            index.append(np.full(count, k))
            ready.append(rows[:count])
            waiting[k] = rows[count:] if count < len(rows) else next(streams[k], None)
        cameras, merged = np.concatenate(index), np.concatenate(ready)
        order = np.lexsort((cameras, merged[:, TIME]))
        yield cameras[order], merged[order]


def _columns(index: NDArray[np.int64], rows: Array, names: Sequence[str], extra: Sequence[str]) -> dict[str, Any]:
    columns: dict[str, Any] = {
        "time_s": rows[:, TIME].copy(),
        "camera": [names[k] for k in index.tolist()],
        "frame": rows[:, FRAME].astype(np.int64),
    }
    for name in ("u_px", "v_px", *extra):
        values = rows[:, COLUMNS.index(name)]
        mask = np.isnan(values)
        kind = np.int64 if name == "object_id" else np.float64
        columns[name] = np.ma.masked_array(np.where(mask, 0, values).astype(kind), mask=mask)
    return columns
