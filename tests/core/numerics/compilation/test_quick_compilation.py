"""Compilation of kernels leaves Python and numba as they were."""

from __future__ import annotations

import gc
import math

import pytest
from numba.core.types.functions import Function

from stereophd.core.numerics.compilation.compiled import compiled
from stereophd.core.numerics.compilation.kernel_units import quick_compilation

# numba's own, before anything is compiled
GET_CALL_TYPE = Function.get_call_type


def test_the_collector_and_numba_are_restored() -> None:
    assert gc.isenabled()
    with quick_compilation():
        assert not gc.isenabled()
        with quick_compilation():
            assert Function.get_call_type is not GET_CALL_TYPE
        assert not gc.isenabled()
    assert gc.isenabled()
    assert Function.get_call_type is GET_CALL_TYPE


def test_both_are_restored_after_an_error_of_a_kernel() -> None:
    def wrong(x: float) -> float:
        return math.sqrt("text")  # type: ignore[arg-type]

    with pytest.raises(Exception, match="sqrt"):
        compiled(wrong)(1.0)
    assert gc.isenabled()
    assert Function.get_call_type is GET_CALL_TYPE


def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        with quick_compilation():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


def test_one_operator_for_several_types() -> None:
    def half(a: float, b: float) -> float:
        return a / b + a % b + min(a, b)

    kernel = compiled(half)
    assert kernel(7, 2) == half(7, 2)
    assert kernel(7.5, 2) == half(7.5, 2)
    assert kernel(7, 2.5) == half(7, 2.5)
