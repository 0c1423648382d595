"""YAML with places: scalars as YAML 1.2 has them, and the line of every key."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from stereophd.config.yaml import parse_yaml

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(10**9), 10**9),
    st.floats(allow_nan=False),
    st.text("abcé :#-'\"", max_size=8),
)
DATA = st.recursive(
    SCALARS,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.text("abc_", min_size=1, max_size=5), inner, max_size=4),
    ),
    max_leaves=20,
)


@given(data=DATA, flow=st.sampled_from([True, False, None]))
def test_what_pyyaml_writes_is_read_back(data: Any, flow: bool | None) -> None:
    text = yaml.safe_dump(data, default_flow_style=flow, allow_unicode=True)
    assert parse_yaml(text, "file").data == data


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e-6", 1e-6),
        ("1e3", 1000.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("-.inf", float("-inf")),
        ("0x1F", 31),
        ("0o17", 15),
        ("010", 10),
        ("+3", 3),
        ("~", None),
        ("", None),
        ("True", True),
        ("yes", "yes"),
        ("off", "off"),
        ("2020-01-01", "2020-01-01"),
        ("1_000", "1_000"),
        ("1:30", "1:30"),
        ("'1'", "1"),
    ],
)
def test_scalars(text: str, value: Any) -> None:
    found = parse_yaml(f"key: {text}", "file").data["key"]
    assert found == value
    assert type(found) is type(value)


def test_places() -> None:
    tree = parse_yaml("a:\n  b: 1\n  c:\n  - 2\n  - d: 3\n", "file.yaml")
    assert str(tree.place(("a",))) == "file.yaml:1"
    assert str(tree.place(("a", "b"))) == "file.yaml:2"
    assert str(tree.place(("a", "c", 1, "d"))) == "file.yaml:5"
    assert str(tree.place(("a", "c", 1, "missing"))) == "file.yaml:5"
    assert str(tree.place(("a", "missing"))) == "file.yaml:1"
