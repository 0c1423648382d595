"""Messages of frames: read, written, refused with their place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from stereophd.errors import InputError
from stereophd.io.streams.documents import schema
from stereophd.io.streams.messages import Message, messages_of_rows, parse_line

FRAME = {"camera": "left", "frame": 7, "time_s": 0.1 + 0.2, "detections": [[612.5, 301.25], [0.1, 240.9]]}


def test_a_line_is_a_frame() -> None:
    message = parse_line(json.dumps(FRAME), "input: line 1")
    assert (message.camera, message.frame, message.time_s) == ("left", 7, 0.1 + 0.2)
    np.testing.assert_array_equal(message.pixels, FRAME["detections"])
    assert message.columns == {}


def test_a_frame_comes_back_from_its_line_to_the_last_bit() -> None:
    pixels = np.random.default_rng(0).uniform(0, 640, (5, 2))
    columns = {"sigma_u_px": np.full(5, 1 / 3), "sigma_v_px": np.full(5, 2 / 3)}
    message = parse_line(Message("a", 3, 1e9 + 1 / 3, pixels, columns).to_line(), "line 1")
    assert message.time_s == 1e9 + 1 / 3
    np.testing.assert_array_equal(message.pixels, pixels)
    assert list(message.columns) == list(columns)
    for name, values in columns.items():
        np.testing.assert_array_equal(message.columns[name], values)


def test_a_frame_without_detections_is_a_frame() -> None:
    message = parse_line('{"camera": "a", "frame": 0, "time_s": 0, "detections": [], "other": 1}', "line 1")
    assert message.pixels.shape == (0, 2)
    again = parse_line(message.to_line(), "line 1")
    assert again.pixels.shape == (0, 2)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ("{", "expected a frame as one line of JSON, found '{'"),
        ("[1]", "expected a frame as one line of JSON"),
        ("[" * 100_000, "expected a frame as one line of JSON"),
        ({"camera": None}, "camera: expected str, found null"),
        ({"frame": 1.5}, "frame: expected int, found float"),
        ({"frame": True}, "frame: expected int, found bool"),
        ({"time_s": "now"}, "time_s: expected float, found str"),
        ({"detections": [[1, 2], [3]]}, r"detections: expected rows of 2 numbers \(u_px, v_px\), found"),
        ({"detections": [["a", 2]]}, r"detections\[0\]\[0\]: expected float \| null, found str"),
        ({"frame": 2**70}, "frame: expected int <= 9223372036854775807"),
        ('{"camera": "a"}', "object missing required field frame"),
        ({"columns": ["score"]}, r"detections: expected rows of 3 numbers \(u_px, v_px, score\)"),
        ({"columns": [1]}, r"columns\[0\]: expected str, found int"),
    ],
)
def test_what_is_no_frame_is_refused_with_its_place(change: object, expected: str) -> None:
    line = change if isinstance(change, str) else json.dumps(FRAME | change)  # type: ignore[operator]
    with pytest.raises(InputError, match=f"input: line 4: {expected}"):
        parse_line(line, "input: line 4")


def test_numbers_that_json_does_not_know_are_missing_values() -> None:
    for text in ("NaN", "null"):
        line = json.dumps(FRAME).replace("612.5", text)
        np.testing.assert_array_equal(parse_line(line, "line 1").pixels[0], [np.nan, 301.25])


def test_the_schema_in_the_repository_is_that_of_the_code() -> None:
    file = Path(__file__).resolve().parents[3] / "docs" / "reference" / "messages.schema.json"
    assert json.loads(file.read_text()) == schema()
    assert set(FRAME) == set(schema()["$defs"]["FrameDocument"]["required"])


def test_rows_of_a_log_are_frames() -> None:
    batch = pa.RecordBatch.from_pydict(
        {
            "time_s": [0.0, 0.0, 0.1, 0.1],
            "camera": ["a", "a", "b", "a"],
            "frame": [0, 0, 0, 1],
            "u_px": [1.0, 3.0, None, 5.0],
            "v_px": [2.0, 4.0, None, 6.0],
            "score": [0.5, 0.25, None, 1.0],
        }
    )
    messages = list(messages_of_rows(batch, "stream"))
    assert [(m.camera, m.frame, m.time_s, m.pixels.tolist()) for m in messages] == [
        ("a", 0, 0.0, [[1.0, 2.0], [3.0, 4.0]]),
        ("b", 0, 0.1, []),
        ("a", 1, 0.1, [[5.0, 6.0]]),
    ]
    assert messages[0].columns["score"].tolist() == [0.5, 0.25]


def test_rows_that_are_no_log_are_refused() -> None:
    with pytest.raises(InputError, match="stream: expected the columns of a detection log, found none named camera"):
        list(
            messages_of_rows(
                pa.RecordBatch.from_pydict({"time_s": [0.0], "frame": [0], "u_px": [1.0], "v_px": [1.0]}), "stream"
            )
        )
