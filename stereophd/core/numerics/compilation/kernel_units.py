"""Large kernels are compiled once, apart from their callers, and numba is made quicker while it compiles.

numba links the code of every kernel into each of its callers, and optimises all of it again there: the cost of a deep
tree of calls grows with its depth. A kernel that is too large to be inlined gains nothing by that. Such a kernel is an
`apart` unit here: its callers hold only its symbol, and the machine code of a caller is linked against the one compiled
form. For this, the symbol of a kernel must be the same in every process that compiles it (numba numbers them in order
of compilation), and a process that finds a compiled caller must load its units first.

numba is Python for the greater part. While it compiles, two costs are avoided, which changes nothing of what it
compiles: the search for garbage (little of what a compiler makes becomes garbage before it ends), and the repeated
choice of the form of a built-in function (the operators, `math.sqrt`, `len`, ...) for the same types of arguments, for
which numba tries all forms that it knows at every place.

What a kernel returns to Python is made by its class, which numba reads from bytes again at each call; here the class is
one of the constants that are kept with the kernel.
"""

import contextlib
import gc
import hashlib
import re
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
from numba.core.base import BaseContext
from numba.core.compiler import Compiler
from numba.core.pythonapi import PythonAPI
from numba.core.types import functions

# The folder that holds the package.
PACKAGE_PARENT = Path(__file__).resolve().parents[4]

_IMPORT = re.compile(r"^\s*from (stereophd(?:\.\w+)*) import ([^\n#]+)", re.MULTILINE)


@cache
def _read_source(file: Path) -> tuple[bytes, frozenset[Path]]:
    """Return the hash of a file's contents, and the files of the package that it imports directly."""
    content, found = file.read_bytes(), set()
    for module, names in _IMPORT.findall(content.decode()):
        path = PACKAGE_PARENT.joinpath(*module.split("."))
        if path.with_suffix(".py").is_file():
            found.add(path.with_suffix(".py"))
        for name in re.findall(r"\w+", names):
            if (path / f"{name}.py").is_file():
                found.add(path / f"{name}.py")
    return hashlib.sha256(content).digest(), frozenset(found)


@cache
def source_digest(file: Path) -> str:
    """Return the hash of the contents of a source file and of all files of the package that it imports, in turn."""
    files, waiting = {file}, [file]
    while waiting:
        new = _read_source(waiting.pop())[1] - files
        files |= new
        waiting += new
    return hashlib.sha256(b"".join(_read_source(path)[0] for path in sorted(files))).hexdigest()


# Instructions (after optimisation) from which on a kernel is a unit of its own. LLVM inlines functions of some 50.
APART_INSTRUCTIONS = 200

_UNITS_OF = "_stereophd_units"
_DIGEST_LENGTH = 16
# The cases of a `switch` have lines of their own, further in.
_INSTRUCTION = re.compile(r"^  [^ \]]", re.MULTILINE)


class Unit(NamedTuple):
    """A compiled form that callers are linked against."""

    kernel: tuple[str, str, int]  # Module, qualified name and first line of its function
    arguments: tuple[Any, ...]  # Types of the arguments (numba)
    symbol: str  # Name of its machine code


# Kernels by the names in `Unit`: whoever loads a caller has imported its units.
_DISPATCHERS: dict[tuple[str, str, int], Any] = {}


class KernelCompiler(Compiler):  # type: ignore[misc]
    """numba's compiler, with symbols that depend on the sources alone."""

    def _compile_bytecode(self) -> Any:
        function = self.state.func_id.func
        text = f"{source_digest(Path(function.__code__.co_filename).resolve())} {function.__code__.co_firstlineno}"
        self.state.func_id.unique_id = hashlib.sha256(text.encode()).hexdigest()[:_DIGEST_LENGTH]
        with quick_compilation():
            return super()._compile_bytecode()


def name_of(function: Any) -> tuple[str, str, int]:
    """Return the name of a kernel's function, as in a `Unit`."""
    return function.__module__, function.__qualname__, function.__code__.co_firstlineno


def register(dispatcher: Any) -> None:
    """Make a kernel known to those that load its callers."""
    _DISPATCHERS.setdefault(name_of(dispatcher.py_func), dispatcher)


def units_of(form: Any) -> tuple[Unit, ...]:
    """Return the units that the machine code of a form, just compiled, is linked against."""
    found = dict.fromkeys(
        unit for library in form.library._linking_libraries for unit in getattr(library, _UNITS_OF, ())
    )
    return tuple(found)


def set_apart(form: Any, function: Any, units: Iterable[Unit], apart: bool) -> None:
    """Decide what callers of a form are linked against: the form itself if it is apart, else what it needs."""
    library = form.library
    if not apart:
        setattr(library, _UNITS_OF, tuple(units))
        return
    unit = Unit(name_of(function), tuple(form.signature.args), form.fndesc.llvm_func_name)
    setattr(library, _UNITS_OF, (unit,))
    library._shared_module = llvm.parse_assembly(str(library.codegen._create_empty_module(library.name)))


def is_large(form: Any) -> bool:
    """Whether a form, just compiled, is too large to be inlined."""
    function = form.library.get_function(form.fndesc.llvm_func_name)
    # to walk through the instructions takes far longer than to count the lines that hold one
    return len(_INSTRUCTION.findall(str(function))) >= APART_INSTRUCTIONS


def load_units(units: Iterable[Unit], target_context: Any) -> bool:
    """Load, or compile, what a form is linked against; False if that is not to be had."""
    for unit in units:
        dispatcher = _DISPATCHERS.get(unit.kernel)
        if dispatcher is None:
            return False
        dispatcher.compile(unit.arguments)
        if not target_context.codegen()._engine.is_symbol_defined(unit.symbol):
            return False
    return True


# Types of calls of built-in functions, by function, context and types of arguments.
_CALL_TYPES: dict[tuple[Any, ...], Any] = {}

# numba's classes of built-in functions and of targets, untyped: a method of each is exchanged for a while
_FUNCTION: Any = functions.Function
_CONTEXT: Any = BaseContext
_get_call_type, _get_python_api = _FUNCTION.get_call_type, _CONTEXT.get_python_api


class _KernelInterface(PythonAPI):  # type: ignore[misc]
    """What the code of a kernel calls of Python, with classes as constants of the kernel."""

    _constants: Any = None

    def from_native_value(self, typ: Any, val: Any, env_manager: Any = None) -> Any:
        """Return the object of a native value."""
        self._constants = env_manager
        return super().from_native_value(typ, val, env_manager)

    def serialize_object(self, obj: Any) -> Any:
        """Return the place of an object, here a class itself."""
        is_held = isinstance(obj, type) and self._constants is not None
        return obj if is_held else super().serialize_object(obj)

    def unserialize(self, structptr: Any) -> Any:
        """Return a new reference to the object at a place."""
        if not isinstance(structptr, type):
            return super().unserialize(structptr)
        held = self._constants.read_const(self._constants.add_const(structptr))
        self.incref(held)
        return held


def _kernel_interface(self: Any, builder: Any) -> Any:
    return _KernelInterface(self, builder)


@contextlib.contextmanager
def quick_compilation() -> Iterator[None]:
    """Compile kernels in the block; blocks may be nested, and only one thread compiles (numba has one lock)."""
    if _FUNCTION.get_call_type is not _get_call_type:
        yield
        return
    collects = gc.isenabled()
    gc.disable()
    _FUNCTION.get_call_type, _CONTEXT.get_python_api = _remembered_call_type, _kernel_interface
    try:
        yield
    finally:
        _FUNCTION.get_call_type, _CONTEXT.get_python_api = _get_call_type, _get_python_api
        if collects:
            gc.enable()


def _remembered_call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of a call, as numba finds it at the first of the same kind."""
    key = self, context, tuple(args), tuple(sorted(kws.items()))
    found = _CALL_TYPES.get(key)
    if found is None:
        found = _CALL_TYPES[key] = _get_call_type(self, context, args, kws)
    return found
