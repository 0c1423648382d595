"""Where a long log is cut into pieces, and how long before its own span each piece is tracked."""

import math
from collections.abc import Iterable
from dataclasses import dataclass

from stereophd.errors import InputError
from stereophd.io.logs.reading import Frame
from stereophd.pipeline.runs.progress import Progress
from stereophd.wording import instant

# A piece is tracked this long before its span, s: an object in only one view keeps the depth that it had in two,
# so the time is that for which objects stay in one view.
OVERLAP_S = 60.0

# More pieces than this are an error.
MOST_PIECES = 100_000

# Frames between two calls of `progress` while a log is read.
TICK_EVERY = 5000


@dataclass(frozen=True)
class LogPiece:
    """A piece of a log."""

    number: int
    # `from_s`, `to_s`: Its own span of true time.
    from_s: float
    to_s: float
    # `begin_s`, `end_s`: What is tracked.
    begin_s: float
    end_s: float
    # Events of the log before `begin_s`: filters choose their samples by the number of an event, and so choose those
    # of the whole run.
    events_before: int


def overlap_of(length_s: float, overlap_s: float | None) -> float:
    """Return the overlap of pieces, s: as stated, else 60 s, or the length of shorter pieces.

    Raises InputError if the length is not above 0, or the overlap is longer than a piece.
    """
    if not 0.0 < length_s < math.inf:
        raise InputError(f"`pieces_s`: expected a length above 0 s, found {length_s:g}")
    if overlap_s is None:
        return min(OVERLAP_S, length_s)
    if not 0.0 < overlap_s <= length_s:
        raise InputError(
            f"`overlap_s`: expected more than 0 s and at most a piece's {length_s:g} s, found {overlap_s:g}"
        )
    return overlap_s


def plan_pieces(
    frames: Iterable[Frame], length_s: float, overlap_s: float, ahead: bool, progress: Progress | None = None
) -> tuple[LogPiece, ...]:
    """Cut a log into pieces of one length; the last one is longer by up to the overlap, or shorter.

    Spans without a frame have no piece: a pause of the recording costs nothing. The frames of the log are read once,
    with all its checks, and `progress` is called now and then. With `ahead` pieces continue beyond their spans too.
    """
    first_s, last_s = math.nan, math.nan
    # Number of a span of the length, from the first frame on -> events before what is tracked with it.
    before: dict[int, int] = {}
    spans: set[int] = set()  # Those with a frame
    for number, frame in enumerate(frames):
        first_s = frame.time_s if number == 0 else first_s
        span = math.floor((frame.time_s - first_s) / length_s)
        # The division rounds; the cuts are these products.
        span += int(frame.time_s >= first_s + (span + 1) * length_s) - int(frame.time_s < first_s + span * length_s)
        spans.add(span)
        before.setdefault(span, number)
        if frame.time_s >= first_s + (span + 1) * length_s - overlap_s:
            before.setdefault(span + 1, number)
        if len(spans) > MOST_PIECES:
            raise InputError(
                f"`pieces_s`: expected at most {MOST_PIECES} pieces, found more of {length_s:g} s until "
                f"{instant(frame.time_s)} s: choose longer pieces, or cut the log"
            )
        last_s = frame.time_s
        if progress is not None and number % TICK_EVERY == 0:
            progress(0, 1)
    if not spans:
        return (LogPiece(0, -math.inf, math.inf, -math.inf, math.inf, 0),)
    last = max(0, math.floor((last_s - overlap_s - first_s) / length_s))
    kept = sorted({min(span, last) for span in spans})
    more = overlap_s if ahead else 0.0
    pieces = []
    for number, span in enumerate(kept):
        from_s = -math.inf if number == 0 else first_s + span * length_s
        to_s = math.inf if number == len(kept) - 1 else first_s + (span + 1) * length_s
        begun = before[span] if span in before else before[span + 1]
        pieces.append(LogPiece(number, from_s, to_s, from_s - overlap_s, to_s + more, begun))
    return tuple(pieces)
