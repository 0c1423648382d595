"""How the package's hot loops are compiled (numba)."""

from collections.abc import Callable
from functools import cached_property
from typing import Any, TypeVar, cast

from numba.core.registry import CPUDispatcher
from numba.core.types.misc import unliteral

from stereophd.core.numerics.compilation.kernel_cache import KernelCache
from stereophd.core.numerics.compilation.kernel_units import KernelCompiler, register

Function = TypeVar("Function", bound=Callable[..., object])

# Sums may be reordered and contracted, but NaN and infinity keep their meaning: samples behind a
# camera produce them, and the test of the field of view relies on comparisons with them being false.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}

_OPTIONS = {"nopython": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}


class Kernel(CPUDispatcher):  # type: ignore[misc]
    """A compiled function whose forms for other kernels have no wrapper for the interpreter.

    Most kernels are called from kernels only, and to compile the wrapper, which takes arrays apart and puts results
    together, takes as long as to compile a small kernel. What Python calls is compiled with its wrapper, and kept, as
    a form of its own.
    """

    def __init__(self, py_func: Any, locals: Any = None, targetoptions: Any = None, pipeline_class: Any = None) -> None:
        options = {**(targetoptions or {}), "no_cpython_wrapper": True}
        super().__init__(py_func, locals or {}, options, pipeline_class or KernelCompiler)
        self._cache = KernelCache(py_func, for_python=False)
        register(self)

    @cached_property
    def for_python(self) -> CPUDispatcher:
        """The forms that Python calls."""
        dispatcher = CPUDispatcher(
            self.py_func, self.locals, {**self.targetoptions, "no_cpython_wrapper": False}, KernelCompiler
        )
        dispatcher._cache = KernelCache(self.py_func, for_python=True)
        return dispatcher

    def add_overload(self, cres: Any) -> None:
        """Add a form for other kernels, which Python cannot call."""
        self.overloads[tuple(cres.signature.args)] = cres

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the form for a call by another kernel: one form for all values of a number."""
        args = [unliteral(kind) for kind in args]
        return super().get_call_template(args, {name: unliteral(kind) for name, kind in kws.items()})

    def _compile_for_args(self, *args: Any, **kws: Any) -> Any:
        entry = self.for_python._compile_for_args(*args, **kws)
        for cres in self.for_python.overloads.values():
            if cres.entry_point is entry:
                self._insert([kind._code for kind in cres.signature.args], entry, False)
        return entry


def compiled(function: Function) -> Function:
    """Compile a kernel: cached on disk, without the interpreter lock, IEEE division by zero.

    Returns the compiled dispatcher, with the type of `function`.
    """
    return cast("Function", Kernel(function, targetoptions=_OPTIONS))


def compiled_fast(function: Function) -> Function:
    """As `compiled`, with sums that the compiler may reorder, so that loops over samples vectorise.

    Only for a large function that consists of sums and is not inlined: its code is then the same for all callers. An
    inlined function is compiled anew with each caller. If its sums may be reordered, its last bits depend on the caller
    and on the copy that a process finds first, so that a run that compiles and a run that finds compiled code would
    differ.
    """
    return cast("Function", Kernel(function, targetoptions={**_OPTIONS, "fastmath": FASTMATH}))
