"""Large kernels are compiled once, apart from their callers, and loaded with them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from stereophd.core.numerics.compilation import kernel_cache, kernel_units
from stereophd.core.numerics.compilation.compiled import compiled


def _half(x: float) -> float:
    return 0.5 * x


@pytest.fixture
def folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    monkeypatch.setattr(kernel_cache, "kernel_folders", lambda: (tmp_path,))
    monkeypatch.setattr(kernel_units, "_DISPATCHERS", {})
    yield tmp_path
    kernel_cache._FAILED.clear()


def _kernels(apart: bool, monkeypatch: pytest.MonkeyPatch) -> tuple[Any, Any]:
    """A kernel and its caller, as a new process would have them."""
    monkeypatch.setattr(kernel_units, "APART_INSTRUCTIONS", 0 if apart else 1000)
    monkeypatch.setattr(kernel_units, "_DISPATCHERS", {})
    half = compiled(_half)

    def caller(x: float) -> float:
        return half(x) + 1.0

    return half, compiled(caller)


def _form(kernel: Any) -> Any:
    (form,) = kernel.overloads.values()
    return form


@pytest.mark.parametrize("apart", [True, False])
def test_callers_are_linked_against_large_kernels_only(
    folder: Path, monkeypatch: pytest.MonkeyPatch, apart: bool
) -> None:
    half, caller = _kernels(apart, monkeypatch)
    assert caller(3.0) == 2.5
    needed = [unit.symbol for unit in kernel_units.units_of(_form(caller.for_python))]
    assert needed == ([_form(half).fndesc.llvm_func_name] if apart else [])


def test_symbols_do_not_depend_on_the_order_of_compilation(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = []
    for _ in range(2):
        half, caller = _kernels(True, monkeypatch)
        assert caller(1.0) == 1.5
        names.append(_form(half).fndesc.llvm_func_name)
    assert names[0] == names[1]


def test_a_kernel_that_other_kernels_call_can_be_called_from_python_too(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half, caller = _kernels(True, monkeypatch)
    assert caller(3.0) == 2.5
    assert half(3.0) == 1.5
    assert caller(4.0) == 3.0


def test_units_that_are_not_to_be_had(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    half, caller = _kernels(True, monkeypatch)
    assert caller(3.0) == 2.5
    (unit,) = kernel_units.units_of(_form(caller.for_python))
    context = half.targetctx
    assert kernel_units.load_units([unit], context)
    assert not kernel_units.load_units([unit._replace(symbol="another")], context)
    assert not kernel_units.load_units([unit._replace(kernel=("a", "b", 1))], context)
